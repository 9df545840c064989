"""Whether two keyframes are of one place: one's cloud is registered to the surroundings of the other, and the reverse.

A pose counts only if many points of each cloud lie on the other's surfaces, the surfaces hold every direction, and both
registrations end at the same pose. Ground lies on ground anywhere: only what stands out of it is judged, and of the
points that are registered it makes up no more than half.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import product

import numpy as np
import small_gicp

from hybridlio.cloud.plane_fitting import MIN_NEIGHBOURS
from hybridlio.cloud.voxel import voxel_average, voxel_pick
from hybridlio.core import se3
from hybridlio.core.arrays import Array, Index
from hybridlio.core.setting_checks import check_fraction, check_not_negative, check_positive, check_setting
from hybridlio.record.loop_keyframes import LoopKeyframes
from hybridlio.registration.icp import Registration, RegistrationSettings, fit_at, register
from hybridlio.registration.information import NORMAL_NOISE, covariance_of, degenerate_directions
from hybridlio.registration.surface import Surface
from hybridlio.smoothing.step_uncertainty import OdometryChain


def _registration() -> RegistrationSettings:
    return RegistrationSettings(max_iterations=30, threads=1)  # for so few points threads cost more than they save


@dataclass(frozen=True)
class VerificationSettings:
    """When a candidate is taken for a loop.

    Attributes:
        reach_m: keyframes so far along the path on either side are merged to the surroundings.
        surface_voxel_m, source_voxel_m: sides of the voxels that thin the surroundings, and the cloud laid on them.
        neighbours: points to fit a plane to for a normal.
        min_standing: with fewer points of a keyframe that are not of ground, it closes no loop.
        min_matched: share of these that must lie near a surface.
        max_cost: of their mean robust cost, between 0 and 1.
        max_difference_m, max_difference_deg: between the registrations of either cloud to the other's surroundings.
        covariance_scale: how much larger the covariance is than independent residuals would make it.
        registration: kernel, distances, limits.

    Raises:
        SettingError: a value is out of range.
    """

    reach_m: float = 10.0
    surface_voxel_m: float = 0.4
    source_voxel_m: float = 1.0
    neighbours: int = 10
    min_standing: int = 50
    min_matched: float = 0.7
    max_cost: float = 0.55
    max_difference_m: float = 0.3
    max_difference_deg: float = 0.5
    covariance_scale: float = 6.0
    registration: RegistrationSettings = field(default_factory=_registration)

    def __post_init__(self) -> None:
        check_positive(
            self, "surface_voxel_m", "source_voxel_m", "max_difference_m", "max_difference_deg", "covariance_scale"
        )
        check_not_negative(self, "reach_m", "min_standing")
        check_fraction(self, "min_matched", "max_cost")
        check_setting(
            self, "neighbours", self.neighbours >= MIN_NEIGHBOURS, f"{MIN_NEIGHBOURS} or more, as a plane needs"
        )


@dataclass(frozen=True, eq=False)
class Verdict:
    """What verification says of a candidate.

    Attributes:
        reason: why it is no loop; empty for one that is.
        pose: ``(4, 4)`` ``T_earlier_later``; the best that was found.
        covariance: ``(6, 6)`` of a right perturbation, rad² and m², rotation first; of a loop only.
        matched, cost: of what stands out of the ground; the worse of the two registrations.
    """

    reason: str
    pose: Array
    covariance: Array
    matched: float
    cost: float


@dataclass(frozen=True, eq=False)
class _Source:
    """A keyframe's points to register, and those of them that stand out of the ground, ``(N, 3)`` and ``(M, 3)``."""

    points: Array
    standing: Array


@dataclass(frozen=True)
class _Fit:
    """How what stands out of the ground lies on a surface: share of points near one, and mean robust cost."""

    matched: float
    cost: float


_LEVEL = 0.7  # a normal's vertical part in a lidar's frame above which it is of ground, or of a roof
_FINE_START_M = 0.5  # the kernel of the last registration begins so wide
_SPARSE = 4  # one in so many points is enough to tell a metre from another
_COARSE_ITERATIONS = 8
_COARSE_KERNEL_M = 2.0
_AHEAD_M, _LEFT_M = (0.0, -3.0, 3.0), (0.0, -2.0, 2.0)
_LIKELY = 3
_SURFACES_KEPT = 64
_UNKNOWN = np.full((6, 6), np.nan)


class Verifier:
    """Registers keyframes to each other's surroundings.

    Args:
        keyframes: of the run.
        chain: its odometry, of which only relative poses of neighbours are used.
        settings: limits.
    """

    def __init__(self, keyframes: LoopKeyframes, chain: OdometryChain, settings: VerificationSettings) -> None:
        self._keyframes, self._chain, self._settings = keyframes, chain, settings
        self._surface = lru_cache(_SURFACES_KEPT)(self._make_surface)
        self._source = lru_cache(_SURFACES_KEPT)(self._make_source)

    def surroundings(self, k: int) -> Array:
        """Points ``(N, 3)`` of keyframe ``k`` and its neighbours along the path, in its frame."""
        near, rows = self._near(k), self._keyframes.rows
        relative = self._chain.relative(rows[k], rows[near])
        clouds = [self._keyframes.points(int(j)) for j in near]
        return np.concatenate([se3.transform(T, points) for T, points in zip(relative, clouds, strict=True)])

    def verify(self, earlier: int, later: int, guesses: Sequence[Array]) -> Verdict:
        """Find the relative pose of two keyframes from several starts, and judge it.

        Args:
            earlier, later: numbers of the keyframes.
            guesses: ``(4, 4)`` poses ``T_earlier_later`` near which to look.
        """
        one, other, settings = self._source(earlier), self._source(later), self._settings.registration
        if min(len(one.standing), len(other.standing)) < self._settings.min_standing:
            return Verdict("hardly anything stands out of the ground", guesses[0], _UNKNOWN, 0.0, 1.0)
        surface = self._surface(earlier)
        there = register(surface, other.points, self._search(surface, other, guesses), settings, _FINE_START_M)
        fit = self._fit(surface, other, there)
        if reason := self._wrong(there, fit):
            return Verdict(reason, there.pose, _UNKNOWN, fit.matched, fit.cost)
        surface = self._surface(later)
        back = register(surface, one.points, se3.inverse(there.pose), settings)
        reverse = self._fit(surface, one, back)
        worse = _Fit(min(fit.matched, reverse.matched), max(fit.cost, reverse.cost))
        if reason := self._wrong(back, reverse) or self._differ(there, back):
            return Verdict(reason, there.pose, _UNKNOWN, worse.matched, worse.cost)
        return self._accepted(earlier, later, there, back, worse)

    def _near(self, k: int) -> Index:
        travelled = self._chain.travelled_m[self._keyframes.rows]
        return np.flatnonzero(np.abs(travelled - travelled[k]) <= self._settings.reach_m)

    def _distortion(self, k: int) -> Array:
        """By how much odometry may have misplaced the neighbours of a keyframe: their mean covariance ``(6, 6)``."""
        rows = self._keyframes.rows
        near = rows[self._near(k)]
        return np.asarray(self._chain.covariance(near, np.full(len(near), rows[k])).mean(axis=0))

    def _make_surface(self, k: int) -> Surface:
        thinned = voxel_average(self.surroundings(k), None, self._settings.surface_voxel_m)[0].astype(np.float64)
        cloud = small_gicp.PointCloud(thinned)
        threads = self._settings.registration.threads
        small_gicp.estimate_normals(cloud, None, self._settings.neighbours, threads)
        points, normals = cloud.points()[:, :3], cloud.normals()[:, :3]
        known = np.abs(normals).sum(axis=1) > 0.5  # small_gicp leaves a normal zero where there are too few neighbours
        return Surface(points[known], normals[known], threads)

    def _make_source(self, k: int) -> _Source:
        points = self._keyframes.points(k).astype(np.float64)
        points = points.take(voxel_pick(points, self._settings.source_voxel_m), axis=0)
        surface = self._surface(k)
        index, _ = surface.nearest(points, self._settings.registration.threads)
        level = np.abs(surface.normals[index][:, 2]) > _LEVEL
        ground = points[level][:: max(1, int(level.sum()) // max(1, int((~level).sum())))]
        return _Source(np.concatenate([points[~level], ground]), points[~level])

    def _search(self, surface: Surface, source: _Source, guesses: Sequence[Array]) -> Array:
        """The best of the starts around the guesses: judged by few points, the likelier ones after some steps."""
        sparse, settings = source.points[::_SPARSE], self._settings.registration
        steps = [se3.exp(np.array([0.0, 0.0, 0.0, x, y, 0.0])) for x, y in product(_AHEAD_M, _LEFT_M)]
        starts = [guess @ step for guess in guesses for step in steps]
        starts.sort(key=lambda T: fit_at(surface, sparse, T, _COARSE_KERNEL_M, settings.threads).cost)
        coarse = replace(settings, max_iterations=_COARSE_ITERATIONS)
        tries = [register(surface, sparse, T, coarse, _COARSE_KERNEL_M) for T in starts[:_LIKELY]]
        return min(tries, key=lambda found: found.cost).pose

    def _fit(self, surface: Surface, source: _Source, found: Registration) -> _Fit:
        settings, points = self._settings.registration, source.standing
        _, distance2 = surface.nearest(se3.transform(found.pose, points), settings.threads)
        reach_m = settings.max_distance_m
        cost = fit_at(surface, points, found.pose, settings.kernel_m, settings.threads, reach_m).cost
        return _Fit(float((distance2 < reach_m**2).mean()), cost)

    def _wrong(self, found: Registration, fit: _Fit) -> str:
        if fit.matched < self._settings.min_matched:
            return f"only {fit.matched:.0%} of the points match"
        if fit.cost > self._settings.max_cost:
            return f"the surfaces do not fit (cost {fit.cost:.2f})"
        loose = degenerate_directions(found.hessian, found.lever_arms_m, NORMAL_NOISE.largest)
        return "a direction is not held" if len(loose) else ""

    def _differ(self, there: Registration, back: Registration) -> str:
        gap = se3.log(there.pose @ back.pose)
        metres, degrees = float(np.linalg.norm(gap[3:])), float(np.rad2deg(np.linalg.norm(gap[:3])))
        apart = metres > self._settings.max_difference_m or degrees > self._settings.max_difference_deg
        return f"the two directions differ by {metres:.2f} m and {degrees:.1f}°" if apart else ""

    def _accepted(self, earlier: int, later: int, there: Registration, back: Registration, fit: _Fit) -> Verdict:
        """The mean of the two registrations, each of which is as wrong as its surroundings are."""
        pose = se3.interpolate(there.pose, se3.inverse(back.pose), 0.5)
        covariance = covariance_of(there.hessian, there.sigma_m, self._settings.covariance_scale) / 2
        seen_from_later = se3.rotate_covariance(self._distortion(earlier), se3.inverse(pose))
        covariance = covariance + (seen_from_later + self._distortion(later)) / 4
        return Verdict("", pose, covariance, fit.matched, fit.cost)
