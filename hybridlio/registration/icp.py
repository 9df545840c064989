"""Point-to-plane registration of one scan to a surface, by robust Gauss-Newton steps.

The cost is the unsupervised loss's first term (UnDeepLIO §3.3, ``L_po2pl``) in a robust squared form: with it the
residual network is trained, and its Hessian weighs the between-factor. Correspondences are nearest neighbours.

Matches take longer than a step, so that each are followed by as many steps as they are good for, along which the
distances are linear.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.setting_checks import check_positive
from hybridlio.registration.information import newton_step
from hybridlio.registration.point_to_point import MixedMatches, MixedNeighbours
from hybridlio.registration.surface import Matches, Neighbours, Surface, System

_ROTATION_CONVERGED_RAD = 2e-5
_TRANSLATION_CONVERGED_M = 3e-4
_REMATCH_ROTATION_RAD = 2e-4  # a centimetre at 50 m
_REMATCH_TRANSLATION_M = 5e-3
_MOST_MATCHES = 8  # points between two equally near neighbours would have the pose go to and fro for ever
_FAR = 10.0  # times the way after which neighbours may be others: no second step by those from before


@dataclass(frozen=True)
class RegistrationSettings:
    """How scans are registered.

    Attributes:
        kernel_m: residual at which the Geman-McClure kernel has pushed a point's weight down to a quarter.
        max_distance_m: nearest neighbours farther away do not count.
        max_iterations: Gauss-Newton steps.
        threads: for the nearest-neighbour search.

    Raises:
        SettingError: a value is out of range.
    """

    __pydantic_config__ = {"extra": "forbid"}  # noqa: RUF012  (read from YAML: unknown keys are errors)

    kernel_m: float = 0.1
    max_distance_m: float = 1.0
    max_iterations: int = 30
    threads: int = 2

    def __post_init__(self) -> None:
        check_positive(self, "kernel_m", "max_distance_m", "max_iterations", "threads")


class Fit(NamedTuple):
    """How well points lie on a surface.

    Attributes:
        cost: mean robust cost over all points, between 0 and 1; unmatched points cost 1.
        matched: share of points with a neighbour near enough.
    """

    cost: float
    matched: float

    @property
    def misfit(self) -> float:
        """Mean robust cost of the matched points alone."""
        return (self.cost - (1 - self.matched)) / max(self.matched, 1e-12)


@dataclass(frozen=True, eq=False)
class Registration:
    """The outcome.

    Attributes:
        pose: ``(4, 4)``; maps the scan's points to the surface's frame.
        hessian: ``(6, 6)`` of half the weighted squared residuals at the answer, right perturbation, 1/m² units removed
            (multiply by 1/σ² for information).
        levers_m: ``(3,)`` of the matched points about the scan's axes.
        sigma_m: robust standard deviation of the residuals.
        matched: share of points with a neighbour near enough.
        cost: mean robust cost over all points, between 0 and 1; unmatched points cost 1.
        iterations: steps taken.
        converged: whether the last step was small.
    """

    pose: Array
    hessian: Array
    levers_m: Array
    sigma_m: float
    matched: float
    cost: float
    iterations: int
    converged: bool

    @property
    def fit(self) -> Fit:
        """How well the points lie there."""
        return Fit(self.cost, self.matched)


def register(
    surface: Surface,
    source: Array,
    initial: Array,
    settings: RegistrationSettings,
    kernel_start_m: float = 0.0,
    held: Array | None = None,
    thick_as_points: bool = False,
) -> Registration:
    """Find the pose that lays ``source`` on ``surface``.

    Directions that the points constrain little stay as in ``initial``;
    :func:`hybridlio.registration.degeneracy.observe` finds out which of them the points see nevertheless.

    Args:
        surface: points with normals.
        source: ``(N, 3)`` points of the scan, metres.
        initial: ``(4, 4)`` pose to start from.
        settings: kernel, distances, limits.
        kernel_start_m: a wider kernel to begin with, halved at every step; for an uncertain ``initial``.
        held: ``(6, D)`` directions that stay, of :func:`hybridlio.registration.information.newton_step`,
            instead of the weak ones.
        thick_as_points: bring scan points to the surface's where those make no plane, see
            :mod:`hybridlio.registration.point_to_point`.
    """
    kernel_m, threads = max(settings.kernel_m, kernel_start_m), settings.threads
    descent = _Descent(settings, initial, kernel_m, held, surface.normal_noise.most)
    neighbours = MixedNeighbours(surface, source, threads)
    look = neighbours.mixed if thick_as_points else neighbours.matches
    for _ in range(_MOST_MATCHES):
        again = descent.by(look(descent.pose, max(settings.max_distance_m, 3 * descent.kernel_m)))
        if not again:
            break
    return descent.outcome(len(source))


class _Descent:
    """Steps down from a pose, by matches that are made anew once the pose has moved too far."""

    def __init__(
        self, settings: RegistrationSettings, pose: Array, kernel_m: float, held: Array | None, normal_noise: float
    ) -> None:
        self.pose, self.kernel_m, self._normal_noise = pose, kernel_m, normal_noise
        self._settings, self._held = settings, held
        self._steps, self._converged = 0, False
        self._matches: Matches | MixedMatches
        self._system: System

    def by(self, matches: Matches | MixedMatches) -> bool:
        """Go down as far as the matches are good for; whether others may be better then."""
        self._matches, levers_m, way, length = matches, matches.levers_m, np.zeros(6), np.inf
        while self._steps < self._settings.max_iterations:
            self._system = matches.system(self.kernel_m, way)
            step = np.zeros(6)
            if len(matches) >= 6:
                system = self._system
                step = newton_step(system.hessian, system.gradient, np.inf, levers_m, self._normal_noise, self._held)
            way, self._steps = way + step, self._steps + 1
            narrow = self.kernel_m == self._settings.kernel_m
            self.kernel_m = max(self._settings.kernel_m, self.kernel_m / 2)
            length, self._converged = _size(step), narrow and _is_small(step)
            if self._converged or length > _FAR or (narrow and length < 1 < _size(way)):
                break
        self.pose = self.pose @ se3.exp(way)
        return self._steps < self._settings.max_iterations and _size(way) > 1

    def outcome(self, points: int) -> Registration:
        """Where it ended, of so many points."""
        system, matches, settings = self._system, self._matches, self._settings
        cost = robust_cost(system.distances, points, settings.kernel_m)
        weight = max(float(system.weights.sum()), 1e-12)
        sigma_m = float(np.sqrt((system.weights @ system.distances**2) / weight))
        pose, matched = se3.orthonormalise(self.pose), len(matches) / max(points, 1)
        return Registration(
            pose, system.hessian, matches.levers_m, sigma_m, matched, cost, self._steps, self._converged
        )


def _size(way: Array) -> float:
    """A way's length, where 1 is so far that other neighbours may be nearer."""
    turn_rad, shift_m = _largest(way)
    return max(turn_rad / _REMATCH_ROTATION_RAD, shift_m / _REMATCH_TRANSLATION_M)


def _is_small(step: Array) -> bool:
    turn_rad, shift_m = _largest(step)
    return turn_rad < _ROTATION_CONVERGED_RAD and shift_m < _TRANSLATION_CONVERGED_M


def _largest(way: Array) -> tuple[float, float]:
    """The largest component of the turn and of the shift; six floats are quicker than arrays of them."""
    sizes: list[float] = [abs(part) for part in way.tolist()]
    return max(sizes[:3]), max(sizes[3:])


def fit_at(
    surface: Surface, source: Array, pose: Array, kernel_m: float, threads: int, reach_m: float | None = None
) -> Fit:
    """How well ``source`` lies at a pose, without a step from there.

    Neighbours farther than ``reach_m``, by default three times the kernel, do not count.
    """
    matches = Neighbours(surface, source, threads).matches(pose, 3 * kernel_m if reach_m is None else reach_m)
    return Fit(robust_cost(matches.rows[6], len(source), kernel_m), len(matches) / max(len(source), 1))


def robust_cost(distances: Array, points: int, kernel_m: float) -> float:
    """Mean Geman-McClure cost, between 0 and 1, of so many points, of which those without a distance cost 1."""
    r2 = distances**2
    return float((r2 / (kernel_m**2 + r2)).sum() + points - len(r2)) / max(points, 1)
