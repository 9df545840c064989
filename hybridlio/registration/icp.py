"""Point-to-plane registration of one scan to a surface, by robust Gauss-Newton steps.

The cost is the point-to-plane term of the unsupervised loss (UnDeepLIO §3.3, ``L_po2pl``) in a robust squared form:
residuals, derivatives and kernel are derived in :mod:`hybridlio.registration.surface`. The same cost trains the
residual network, and its Hessian weighs the between-factor.

This is ICP with two departures. Matching costs more than a step, so each set of matches serves several steps, along
which distances are extrapolated linearly, until the pose has moved so far that neighbours may change. And the kernel
may start wide and be halved at every step (graduated non-convexity): a poor start then sees distant planes, and the
minimum is found under the narrow kernel, which wrong matches hardly influence.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.registration.information import free_basis, least_share, scale_of
from hybridlio.registration.point_to_point import MixedMatches, MixedNeighbours
from hybridlio.registration.results import Fit, Registration
from hybridlio.registration.settings import MATCH_KERNELS, RegistrationSettings
from hybridlio.registration.surface import Neighbours, PlaneMatches, Surface

if TYPE_CHECKING:
    from hybridlio.registration.loops import Followed

_MAX_MATCHINGS = 8  # points midway between two neighbours can make the pose alternate without end; 3 to 5 are usual


def register(
    surface: Surface,
    source: Array,
    initial: Array,
    settings: RegistrationSettings,
    kernel_start_m: float = 0.0,
    fixed: Array | None = None,
    match_thick_as_points: bool = False,
) -> Registration:
    """Find the pose at which ``source`` lies on ``surface``.

    Directions with too little information stay as in ``initial``; whether they are observed nevertheless is decided by
    :func:`hybridlio.registration.degeneracy.register_with_degeneracy`.

    Args:
        surface: points with planes.
        source: ``(N, 3)`` points of the scan, metres.
        initial: ``(4, 4)`` pose to start from.
        settings: kernel, distances, limits.
        kernel_start_m: width of a wider kernel to begin with, halved at every step; for an uncertain ``initial``.
        fixed: ``(6, D)`` directions along which the pose stays, in the units of
            :func:`hybridlio.registration.information.newton_step`; by default the weak ones of each step.
        match_thick_as_points: match scan points with points of the surface where its planes are thick, see
            :mod:`hybridlio.registration.point_to_point`.
    """
    neighbours = MixedNeighbours(surface, source, settings.threads)
    return register_neighbours(neighbours, initial, settings, kernel_start_m, fixed, match_thick_as_points)


def register_neighbours(
    neighbours: MixedNeighbours,
    initial: Array,
    settings: RegistrationSettings,
    kernel_start_m: float = 0.0,
    fixed: Array | None = None,
    match_thick_as_points: bool = False,
) -> Registration:
    """Find the pose as :func:`register` does. The neighbours then are those near the pose, for further evaluations."""
    descent = _Descent(
        settings, initial, max(settings.kernel_m, kernel_start_m), fixed, neighbours.surface.normal_noise.largest
    )
    match = neighbours.mixed if match_thick_as_points else neighbours.matches
    for _ in range(_MAX_MATCHINGS):
        matches = match(descent.pose, max(settings.max_distance_m, MATCH_KERNELS * descent.kernel_m))
        if not descent.follow(matches):
            break
    return descent.result(len(neighbours))


class _Descent:
    """Gauss-Newton steps from a pose; the caller supplies new matches whenever the pose has moved too far."""

    def __init__(
        self, settings: RegistrationSettings, pose: Array, kernel_m: float, fixed: Array | None, normal_noise: float
    ) -> None:
        self.pose, self.kernel_m, self._settings = pose, kernel_m, settings
        self._basis, self._least_share = free_basis(fixed), least_share(normal_noise, fixed)
        self._steps = 0
        self._matches: PlaneMatches | MixedMatches
        self._lever_arms_m: Array
        self._followed: Followed

    def follow(self, matches: PlaneMatches | MixedMatches) -> bool:
        """Step as far as the matches are valid. Return whether new matches could lead farther."""
        from hybridlio.registration import loops  # late: compiled

        settings = self._settings
        self._matches, self._lever_arms_m = matches, matches.lever_arms_m
        free = loops.Free(scale_of(self._lever_arms_m)[:, None] * self._basis, self._least_share)
        limits = loops.Limits(settings.kernel_m, settings.max_iterations)
        self._followed = found = loops.follow(matches.rows, free, limits, self.kernel_m, self._steps)
        self.kernel_m, self._steps = found.kernel_m, found.steps
        self.pose = self.pose @ se3.exp(found.way)
        return found.steps < settings.max_iterations and found.rematch_ratio > 1

    def result(self, points: int) -> Registration:
        """Return the registration of a scan with this number of points."""
        found, sums = self._followed, self._followed.sums
        unmatched = points - len(self._matches)
        return Registration(
            pose=se3.orthonormalise(self.pose),
            hessian=sums.hessian,
            lever_arms_m=self._lever_arms_m,
            sigma_m=float(np.sqrt(sums.squares / max(sums.weight, 1e-12))),
            matched=len(self._matches) / max(points, 1),
            cost=float(sums.cost + unmatched) / max(points, 1),
            iterations=found.steps,
            converged=found.converged,
        )


def fit_at(
    surface: Surface, source: Array, pose: Array, kernel_m: float, threads: int, max_distance_m: float | None = None
) -> Fit:
    """Return how well ``source`` ``(N, 3)`` lies on a surface at a pose ``(4, 4)``, without moving it.

    Neighbours farther than ``max_distance_m``, by default three times the kernel, are not matched.
    """
    if max_distance_m is None:
        max_distance_m = MATCH_KERNELS * kernel_m
    matches = Neighbours(surface, source, threads).matches(pose, max_distance_m)
    return Fit(robust_cost(matches.distances, len(source), kernel_m), len(matches) / max(len(source), 1))


def robust_cost(distances: Array, points: int, kernel_m: float) -> float:
    """Return the mean Geman-McClure cost ``r²/(k² + r²)`` of a number of points; those without a distance cost 1."""
    r2 = distances**2
    return float((r2 / (kernel_m**2 + r2)).sum() + points - len(r2)) / max(points, 1)
