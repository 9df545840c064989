"""Verification of a candidate loop: each keyframe's cloud is registered to the merged surroundings of the other.

A pose is accepted if most points of each cloud lie on the other's surfaces, the surfaces constrain every direction, and
both registrations give the same pose. Ground fits ground anywhere, so only points above the ground are judged, and at
most half of the registered points are of the ground.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import product

import numpy as np
import small_gicp

from hybridlio.cloud.plane_fitting import MIN_NEIGHBOURS
from hybridlio.cloud.voxel import voxel_average, voxel_pick
from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.setting_checks import check_fraction, check_not_negative, check_positive, check_setting
from hybridlio.registration.icp import fit_at, register
from hybridlio.registration.information import NORMAL_NOISE, covariance_of, degenerate_directions
from hybridlio.registration.motion_search import CoarseSearch, refine_best
from hybridlio.registration.results import Fit, Registration
from hybridlio.registration.settings import RegistrationSettings
from hybridlio.registration.surface import Surface
from hybridlio.smoothing.places import Places


def _registration() -> RegistrationSettings:
    return RegistrationSettings(max_iterations=30, threads=1)  # threads cost more than they save for so few points


@dataclass(frozen=True)
class VerificationSettings:
    """When a candidate is accepted as a loop; the limits favour no false loop over many loops (benchmarks/loops.py).

    Attributes:
        reach_m: places this near along the path on either side are merged to the surroundings.
        surface_voxel_m, source_voxel_m: voxel sides of the surroundings and of the cloud registered to them.
        neighbours: points to which a plane is fitted for a normal.
        min_above_ground: a keyframe with fewer points above the ground closes no loop.
        min_matched: least share of these points with a surface nearby.
        max_cost: largest mean robust cost of these points, between 0 and 1.
        max_difference_m, max_difference_deg: between the two registrations.
        covariance_scale: factor on the covariance of independent residuals.
        registration: kernel, distances, limits.

    Raises:
        SettingError: a value is out of range.
    """

    reach_m: float = 10.0
    surface_voxel_m: float = 0.4
    source_voxel_m: float = 1.0
    neighbours: int = 10
    min_above_ground: int = 50
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
        check_not_negative(self, "reach_m", "min_above_ground")
        check_fraction(self, "min_matched", "max_cost")
        check_setting(
            self, "neighbours", self.neighbours >= MIN_NEIGHBOURS, f"{MIN_NEIGHBOURS} or more, as a plane needs"
        )


@dataclass(frozen=True, eq=False)
class Verdict:
    """The result of verifying a candidate.

    Attributes:
        reason: why it was rejected; empty if it was accepted.
        pose: ``(4, 4)`` ``T_earlier_later``; the best one found.
        covariance: ``(6, 6)`` of a right perturbation, rad² and m², rotation first; NaN if rejected.
        matched, cost: of the points above the ground; the worse of the two registrations.
    """

    reason: str
    pose: Array
    covariance: Array
    matched: float
    cost: float


@dataclass(frozen=True, eq=False)
class _Source:
    """A keyframe's points to register ``(N, 3)``, and those of them above the ground ``(M, 3)``."""

    points: Array
    above_ground: Array


HORIZONTAL = 0.7  # cos 45°: |z| of a normal above which a surface is ground (or a flat roof)
_FINE_START_M = 0.5  # first kernel of the final registration; the search leaves errors of decimetres
_SPARSE = 4  # every fourth point; enough to compare starts metres apart
# The search: 3 by 3 starts around each guess, no farther apart than the coarse kernel reaches; the best 3 are refined.
_SEARCH = CoarseSearch(kernel_m=2.0, iterations=8, refined=3)
_AHEAD_M, _LEFT_M = (0.0, -3.0, 3.0), (0.0, -2.0, 2.0)
_SURFACES_KEPT = 64  # a second pass over a place needs the same surfaces repeatedly; 64 keyframes span 250 m
_UNKNOWN = np.full((6, 6), np.nan)  # the covariance of a rejected candidate


class PreparedPlaces:
    """Places with their surfaces and the points to register, made when first needed.

    Args:
        places: of a run or of a map.
        settings: how both are thinned.
    """

    def __init__(self, places: Places, settings: VerificationSettings) -> None:
        self.places, self._settings = places, settings
        self.surface = lru_cache(_SURFACES_KEPT)(self._make_surface)
        self.source = lru_cache(_SURFACES_KEPT)(self._make_source)

    def _make_surface(self, k: int) -> Surface:
        thinned = voxel_average(self.places.surroundings(k), None, self._settings.surface_voxel_m)[0].astype(np.float64)
        cloud = small_gicp.PointCloud(thinned)
        threads = self._settings.registration.threads
        small_gicp.estimate_normals(cloud, None, self._settings.neighbours, threads)
        points, normals = cloud.points()[:, :3], cloud.normals()[:, :3]
        known = np.abs(normals).sum(axis=1) > 0.5  # small_gicp leaves a normal zero if there are too few neighbours
        return Surface(points[known], normals[known], threads)

    def _make_source(self, k: int) -> _Source:
        """The place's thinned points, those of the ground thinned further to as many as the others."""
        points = self.places.points(k).astype(np.float64)
        points = points.take(voxel_pick(points, self._settings.source_voxel_m), axis=0)
        surface = self.surface(k)
        index, _ = surface.nearest(points, self._settings.registration.threads)
        is_ground = np.abs(surface.normals[index][:, 2]) > HORIZONTAL
        ground = points[is_ground][:: max(1, int(is_ground.sum()) // max(1, int((~is_ground).sum())))]
        return _Source(np.concatenate([points[~is_ground], ground]), points[~is_ground])


class Verifier:
    """Registers keyframes to each other's surroundings.

    Args:
        earlier, later: the places, of one run or of two.
        settings: limits.
    """

    def __init__(self, earlier: PreparedPlaces, later: PreparedPlaces, settings: VerificationSettings) -> None:
        self._earlier, self._later, self._settings = earlier, later, settings

    def verify(self, earlier: int, later: int, guesses: Sequence[Array]) -> Verdict:
        """Find the relative pose of two keyframes from several starts, and judge it.

        Args:
            earlier, later: numbers of the places.
            guesses: ``(4, 4)`` poses ``T_earlier_later`` near which to search.
        """
        one, other, settings = self._earlier.source(earlier), self._later.source(later), self._settings.registration
        if min(len(one.above_ground), len(other.above_ground)) < self._settings.min_above_ground:
            return Verdict("too few points above the ground", guesses[0], _UNKNOWN, 0.0, 1.0)
        surface = self._earlier.surface(earlier)
        there = register(surface, other.points, self._search(surface, other, guesses), settings, _FINE_START_M)
        fit = self._fit(surface, other, there)
        if reason := self._misfit(there, fit):
            return Verdict(reason, there.pose, _UNKNOWN, fit.matched, fit.cost)
        surface = self._later.surface(later)
        back = register(surface, one.points, se3.inverse(there.pose), settings)
        reverse = self._fit(surface, one, back)
        worse = Fit(cost=max(fit.cost, reverse.cost), matched=min(fit.matched, reverse.matched))
        if reason := self._misfit(back, reverse) or self._difference(there, back):
            return Verdict(reason, there.pose, _UNKNOWN, worse.matched, worse.cost)
        return self._accepted(earlier, later, there, back, worse)

    def _search(self, surface: Surface, source: _Source, guesses: Sequence[Array]) -> Array:
        """Return the best pose after a coarse registration from starts around each guess."""
        steps = [se3.exp(np.array([0.0, 0.0, 0.0, x, y, 0.0])) for x, y in product(_AHEAD_M, _LEFT_M)]
        starts = [guess @ step for guess in guesses for step in steps]
        sparse = source.points[::_SPARSE]
        refined = refine_best(surface, sparse, sparse, starts, self._settings.registration, _SEARCH)
        return min(refined, key=lambda found: found.cost).pose

    def _fit(self, surface: Surface, source: _Source, found: Registration) -> Fit:
        """How well the points above the ground lie on the surface."""
        settings = self._settings.registration
        return fit_at(
            surface, source.above_ground, found.pose, settings.kernel_m, settings.threads, settings.max_distance_m
        )

    def _misfit(self, found: Registration, fit: Fit) -> str:
        """Why a registration is rejected; empty if it is not."""
        if fit.matched < self._settings.min_matched:
            return f"only {fit.matched:.0%} of the points match"
        if fit.cost > self._settings.max_cost:
            return f"the surfaces do not fit (cost {fit.cost:.2f})"
        loose = degenerate_directions(found.hessian, found.lever_arms_m, NORMAL_NOISE.largest)
        return "a direction is not constrained" if len(loose) else ""

    def _difference(self, there: Registration, back: Registration) -> str:
        """Why two registrations in opposite directions are rejected; empty if they are not."""
        gap = se3.log(there.pose @ back.pose)
        metres, degrees = float(np.linalg.norm(gap[3:])), float(np.rad2deg(np.linalg.norm(gap[:3])))
        apart = metres > self._settings.max_difference_m or degrees > self._settings.max_difference_deg
        return f"the two directions differ by {metres:.2f} m and {degrees:.1f}°" if apart else ""

    def _accepted(self, earlier: int, later: int, there: Registration, back: Registration, fit: Fit) -> Verdict:
        """The verdict of a loop: the mean of the two registrations and its covariance.

        Each registration has its own residual noise (half the variance remains in the mean) and the distortion of the
        surroundings it registers to (a quarter of each variance remains).
        """
        pose = se3.interpolate(there.pose, se3.inverse(back.pose), 0.5)
        covariance = covariance_of(there.hessian, there.sigma_m, self._settings.covariance_scale) / 2
        seen_from_later = se3.rotate_covariance(self._earlier.places.distortion(earlier), se3.inverse(pose))
        covariance = covariance + (seen_from_later + self._later.places.distortion(later)) / 4
        return Verdict("", pose, covariance, fit.matched, fit.cost)
