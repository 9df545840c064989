"""Decides whether a weakly constrained direction is truly observed, or only seems so because normals are noisy.

The Hessian cannot tell. On a smooth wall some estimated normals lean forward and some back, strongly at its edges, and
each contributes spurious information along the wall; a few tree trunks in an open field contribute no more. The cost
itself differs: half a metre away, where points find other neighbours, trunks no longer fit, whereas leaning normals fit
as well as before. So the pose is displaced by half a metre to either side of each weak direction, the strong directions
are minimised again, and a parabola through the three costs gives the minimum, its significance and its standard
deviation (:mod:`hybridlio.registration.cost_profile`). If the start is not known to a decimetre, costs up to two metres
away are weighed as likelihoods.

Half a metre is five default kernels. In rooms the kernel is half as wide, and points are matched within a quarter of a
metre: points of floor and ceiling lost their neighbours half a metre away and did not count, and the ends of what had
been seen of the walls looked like structure. So the probe's lengths shrink with the kernel, and neighbours count twice
as far away as it reaches. Not so while the map is one scan or the start is sought: 16 beams hardly see the floor then,
and platforms at rest rose by up to 0.9 m.

A lidar's own pattern looks like structure: where its rings fall on the ground, and the offset of each beam, are the
same in every scan. A scan therefore fits a single other scan best where it has not moved at all; between smooth walls
such minima were up to twelve times as deep as their scatter. A minimum within half a metre of the only other scan is
ignored.

In rooms, what observes a weak direction is mostly a few points of planes, such as the floor's. Some kernels away their
cost hardly changes any more, and a parabola through such costs has its minimum where the pose is, whatever centimetres
are missing. So there Gauss-Newton steps along the observed directions end the registration, and the Hessian gives their
standard deviations. In streets a few trunks and bushes observe them, whose planes are what cannot be trusted, and of a
lidar that does not repeat its pattern single scans are too sparse: an office with a rosette got ten times worse.

On open ground, where all three horizontal directions are weak and observed, a last registration matches thick objects
point by point (:mod:`hybridlio.registration.point_to_point`), with a kernel too narrow to find the minimum by itself.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.registration.cost_profile import OFFSETS_M, PROBE_STEP_M, parabola_minimum, weigh_offsets
from hybridlio.registration.icp import register, register_neighbours
from hybridlio.registration.information import UNKNOWN_SIGMA_M, covariance_of, weak_basis
from hybridlio.registration.point_to_point import MixedNeighbours
from hybridlio.registration.results import ObservedRegistration, Registration
from hybridlio.registration.settings import RegistrationSettings
from hybridlio.registration.surface import Surface

# In the strong directions after a displacement. One step is too few: in a corridor (benchmarks/scenarios.py, seed 7402,
# 150 m) it raises the ANEES of positions by 30 %, and before a bend it leaves a turn
# (tests/hybridlio/registration/test_degeneracy_limits.py). In the corridor all displacements converge within 5 steps;
# there and in a field (seed 7401) a limit of 30 gives the same results to the last bit. Over the sparse first map of a
# lidar with 16 beams a few displacements take up to 19, and the limit moves poses by up to 4 mm.
_PROBE_ITERATIONS = 6
# Of moving to the parabola's minimum. From 0.6 m away in a field, one leaves up to 0.2 m, and three leave millimetres.
_MAX_ROUNDS = 4
_SETTLED_M = 0.1  # a fifth of the parabola's step: closer to the minimum, a new parabola gives the same one
# On the variance of an observed direction, whose few points stand on a few trunks and share their errors. It was scan
# matching's scale, and stayed when that was halved for thin planes. In corridors with bushes the mean squared
# normalised error is then 2 (tests/hybridlio/registration/test_degeneracy_limits.py).
_OBSERVED_VARIANCE_SCALE = 6.0
_OPEN_GROUND_DIRECTIONS = 3  # that are weak on open ground: ahead, sideways and yaw
_POINT_KERNEL_RATIO = 0.3  # of the settings' kernel: 3 cm by default, the noise of the difference of two points
# On the covariance of the point-to-point registration. Each match counts in three directions, and all points on a trunk
# share its error; larger than the scale above because many more points are used.
_POINT_VARIANCE_SCALE = 20.0
_POINT_START_M = 0.1  # either side of the minimum from which point matches must find the same pose; its usual error
_SELF_MATCH_M = 0.5  # from the only other scan, as far as PROBE_STEP_M: beyond it, points have other neighbours


@dataclass(frozen=True, eq=False)
class RegistrationProblem:
    """What is registered to what.

    Attributes:
        surface: a map, or another scan.
        source: ``(N, 3)`` the scan's points that are registered, scan frame, metres.
        settings: of the registration.
        dense_source: ``(M, 3)`` more of the scan's points, for point-to-point matches; None for ``source``.
        only_scan_pose: ``(4, 4)`` pose of the single scan of which the surface is made; None for several scans.
        without_edges: leave out points beyond the edge of what the surface shows, which has no gaps between rings.
        has_rooms_planes: what observes a weak direction is planes of a room, seen densely, in a map of several scans.
    """

    surface: Surface
    source: Array
    settings: RegistrationSettings
    dense_source: Array | None = None
    only_scan_pose: Array | None = None
    without_edges: bool = False
    has_rooms_planes: bool = False

    @property
    def probe_scale(self) -> float:
        """Of the lengths of a probe: one, in rooms smaller as the kernel is."""
        return self.settings.kernel_m / RegistrationSettings().kernel_m if self.has_rooms_planes else 1.0

    @property
    def reach_m(self) -> float:
        """How far neighbours count for a probe: a point that is displaced from its plane is farther away than that."""
        reach_m = self.settings.max_distance_m
        return max(reach_m, 2 * PROBE_STEP_M * self.probe_scale) if self.has_rooms_planes else reach_m

    def neighbours(self) -> MixedNeighbours:
        """Return the source's neighbours on the surface, to be followed from a pose."""
        return MixedNeighbours(self.surface, self.source, self.settings.threads, self.without_edges)


def register_with_degeneracy(
    problem: RegistrationProblem, initial: Array, kernel_start_m: float = 0.0, is_start_vague: bool = False
) -> ObservedRegistration:
    """Register along strong directions by Gauss-Newton, and along weak ones by the costs around the pose.

    Args:
        problem: what is registered to what.
        initial: ``(4, 4)`` pose to start from.
        kernel_start_m: see :func:`hybridlio.registration.icp.register`.
        is_start_vague: ``initial`` is not known to a decimetre: along unobserved directions weigh costs up to 2 m away.
    """
    surface = problem.surface
    neighbours = problem.neighbours()
    found = register_neighbours(neighbours, initial, problem.settings, kernel_start_m)
    noise = surface.normal_noise
    basis, to_tangent = weak_basis(found.hessian, found.lever_arms_m, noise.largest)
    if not basis.shape[1]:
        return ObservedRegistration(found, basis, np.empty((0, 6)), np.empty(0, dtype=bool), np.empty(0), noise.mean)
    probe = _Probe(problem, neighbours, basis, to_tangent)
    found, minima = probe.descend(found)
    is_observed = np.isfinite(minima.sigmas_m) & (not probe.may_match_itself(found.pose))
    found, sigmas_m = probe.refine_by_points(found, minima.sigmas_m, is_observed)
    is_settled = problem.has_rooms_planes and bool(is_observed.any())
    if is_settled:
        found, sigmas_m = probe.settle(found, is_observed)
    sigmas_m = np.where(is_observed, sigmas_m, UNKNOWN_SIGMA_M)
    if is_start_vague and not is_observed.all():
        found, sigmas_m = probe.weigh_costs(found, minima.tangents, sigmas_m, is_observed)
    return ObservedRegistration(found, basis, minima.tangents, is_observed, sigmas_m, noise.mean, is_settled)


@dataclass(frozen=True, eq=False)
class _Minima:
    """Minima of the parabolas along the weak directions: offsets and deviations ``(D,)``, tangents ``(D, 6)``."""

    offsets_m: Array
    tangents: Array
    sigmas_m: Array


@dataclass(frozen=True, eq=False)
class _Probe:
    """Evaluates costs beside a pose along the weak directions, where the strong ones have been minimised again.

    Attributes:
        neighbours: of the source near the pose.
    """

    problem: RegistrationProblem
    neighbours: MixedNeighbours
    basis: Array
    to_tangent: Array

    def descend(self, found: Registration) -> tuple[Registration, _Minima]:
        """Move to the parabolas' minimum until it is near, and return the pose there with the last parabolas."""
        minima = self._parabolas(found)
        for _ in range(_MAX_ROUNDS):
            if not minima.offsets_m.any():
                break
            found = self._register_strong(found.pose @ se3.exp(minima.offsets_m @ minima.tangents))
            if np.abs(minima.offsets_m).max() < _SETTLED_M * self.problem.probe_scale:
                break
            minima = self._parabolas(found)
        return found, minima

    def settle(self, found: Registration, is_observed: NDArray[np.bool_]) -> tuple[Registration, Array]:
        """Step to the minimum along the observed directions, too; return their deviations ``(D,)`` by the Hessian."""
        fixed = self.basis[:, ~is_observed]
        found = register_neighbours(self.neighbours, found.pose, self.problem.settings, fixed=fixed)
        noise = self.problem.surface.normal_noise.mean
        covariance = covariance_of(
            found.hessian, found.sigma_m, 1.0, found.lever_arms_m, noise, np.zeros(6), fixed=fixed
        )
        return found, self._deviations(covariance)

    def weigh_costs(
        self, found: Registration, tangents: Array, sigmas_m: Array, is_observed: NDArray[np.bool_]
    ) -> tuple[Registration, Array]:
        """Move along the unobserved directions to where costs within 2 m make the pose likely, with its deviations."""
        offsets_m, costs_here = np.zeros(len(is_observed)), self._costs(found.pose)
        sigmas_m = sigmas_m.copy()
        for i in np.flatnonzero(~is_observed):
            probes = [self._displace(found.pose, costs_here, offset_m * tangents[i]) for offset_m in OFFSETS_M]
            trusted = np.array([not self.may_match_itself(pose) for pose, _ in probes])
            offsets_m[i], sigmas_m[i] = weigh_offsets([rises for _, rises in probes], trusted)
        return self._register_strong(found.pose @ se3.exp(offsets_m @ tangents)), sigmas_m

    def may_match_itself(self, pose: Array) -> bool:
        """Whether a scan at this pose is so near the only other scan that the lidar's pattern matches itself."""
        only = self.problem.only_scan_pose
        return only is not None and bool(np.linalg.norm(pose[:3, 3] - only[:3, 3]) < _SELF_MATCH_M)

    @property
    def to_weak(self) -> Array:
        """``(D, 6)``: of a tangent vector, metres along each weak direction."""
        return (self.basis / self.to_tangent[:, None]).T

    def _deviations(self, covariance: Array) -> Array:
        """Return the standard deviations ``(D,)`` along the weak directions, m, of a covariance ``(6, 6)``."""
        variances = np.einsum("ij,jk,ik->i", self.to_weak, covariance, self.to_weak)
        # rounding leaves less than 0 along directions that are fixed
        return np.asarray(np.sqrt(np.maximum(variances, 0.0)))

    def refine_by_points(
        self, found: Registration, sigmas_m: Array, is_observed: NDArray[np.bool_]
    ) -> tuple[Registration, Array]:
        """Register once more with thick objects matched by points, and return standard deviations ``(D,)``.

        Only on open ground, where all horizontal directions are weak and observed: beside walls, thick planes are
        mostly the walls' edges, along which points are near each other by chance. The parabola's result, with
        ``sigmas_m`` of independent points, is kept otherwise, and where two starts on either side do not lead to the
        same pose.
        """
        of_parabola = found, np.sqrt(_OBSERVED_VARIANCE_SCALE) * sigmas_m
        if len(is_observed) < _OPEN_GROUND_DIRECTIONS or not is_observed.all():
            return of_parabola
        narrow_m = _POINT_KERNEL_RATIO * self.problem.settings.kernel_m
        near, other = (self._register_by_points(found.pose, way, narrow_m) for way in (1.0, -1.0))
        apart_m, moved_m = (self.to_weak @ se3.log(se3.between(near.pose, pose)) for pose in (other.pose, found.pose))
        if np.abs(apart_m).max() > narrow_m or np.abs(moved_m).max() > PROBE_STEP_M * self.problem.probe_scale:
            return of_parabola
        noise = self.problem.surface.normal_noise.mean
        covariance = covariance_of(near.hessian, near.sigma_m, _POINT_VARIANCE_SCALE, found.lever_arms_m, noise)
        return replace(found, pose=near.pose), self._deviations(covariance)

    def _register_by_points(self, pose: Array, side: float, kernel_m: float) -> Registration:
        """Register in all directions from beside a pose, on the side +1 or −1 of all weak directions."""
        problem, nothing = self.problem, np.empty((6, 0))
        points = problem.source if problem.dense_source is None else problem.dense_source
        start = pose @ se3.exp(side * (_POINT_START_M * self.to_tangent * self.basis.sum(axis=1)))
        settings = replace(problem.settings, kernel_m=kernel_m)
        return register(problem.surface, points, start, settings, problem.settings.kernel_m, nothing, True)

    def _parabolas(self, found: Registration) -> _Minima:
        costs_here, count = self._costs(found.pose), self.basis.shape[1]
        step_m = PROBE_STEP_M * self.problem.probe_scale
        minima = _Minima(np.empty(count), np.empty((count, 6)), np.empty(count))
        for i, direction in enumerate((self.to_tangent[:, None] * self.basis).T):
            back, rises_back = self._displace(found.pose, costs_here, -step_m * direction)
            ahead, rises_ahead = self._displace(found.pose, costs_here, step_m * direction)
            minima.tangents[i] = se3.log(se3.between(back, ahead)) / (2 * step_m)
            minima.offsets_m[i], minima.sigmas_m[i] = parabola_minimum(rises_back, rises_ahead, step_m)
        return minima

    def _register_strong(self, pose: Array) -> Registration:
        """Register with the weak directions fixed."""
        return register_neighbours(self.neighbours, pose, self.problem.settings, fixed=self.basis)

    def _displace(self, pose: Array, costs_here: Array, xi: Array) -> tuple[Array, Array]:
        """Return the pose displaced by ``xi`` and minimised in the strong directions, and the points' rises in cost."""
        settings = replace(self.problem.settings, max_iterations=_PROBE_ITERATIONS)
        neighbours = self.problem.neighbours()
        there = register_neighbours(neighbours, pose @ se3.exp(xi), settings, fixed=self.basis).pose
        rises = neighbours.costs(there, settings.kernel_m, self.problem.reach_m) - costs_here
        return there, np.asarray(rises[~np.isnan(rises)])  # points matched at both poses

    def _costs(self, pose: Array) -> Array:
        """Return the robust cost of each point ``(N,)``, between 0 and 1; NaN where it has no neighbour."""
        settings = self.problem.settings
        return self.neighbours.costs(pose, settings.kernel_m, self.problem.reach_m)
