"""Matching of one scan with a prior map."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.motion_limits import POINT_LEVER_M
from hybridlio.core.setting_checks import check_fraction, check_not_negative, check_positive
from hybridlio.localization.fusion import UncertainPose
from hybridlio.localization.map_surface import MapSurface
from hybridlio.registration.degeneracy import RegistrationProblem, register_with_degeneracy
from hybridlio.registration.icp import fit_at
from hybridlio.registration.motion_search import CoarseSearch, refine_best
from hybridlio.registration.settings import RegistrationSettings
from hybridlio.registration.surface import Surface
from hybridlio.smoothing.loop_verification import HORIZONTAL
from hybridlio.sources.thinned_scan import ThinnedScan

# The search from an uncertain pose. Starts are 3° and 2 m apart: as far as its kernel reaches, 3° at 40 m being 2 m.
_SEARCH = CoarseSearch(kernel_m=2.0, iterations=8, refined=3)
_SEARCH_STEPS = np.array([np.deg2rad(3.0), 2.0, 2.0])  # yaw, ahead, left
_SEARCHED, _MAX_STEPS = np.array([np.deg2rad(20.0), 12.0, 12.0]), 9  # beyond, place recognition is needed
_JUDGED_STRIDE, _SPARSE = 16, 4  # every 16th point compares starts, every fourth refines them


@dataclass(frozen=True)
class MapMatchingSettings:
    """How scans are matched with the map, and when a match holds.

    Attributes:
        min_points: a scan with fewer points is not matched.
        min_matched: least share of the points with a surface of the map nearby. Outside the map it falls.
        max_cost: largest mean robust cost of the points, 0 to 1. Where places have changed it rises.
        min_above_ground, min_matched_above, max_cost_above: the same of the points above the ground, where the place is
            in question: ground fits ground anywhere. From 40 wrong starts the least cost was 0.73, from right ones at
            most 0.23 (simulated towns 9501 and 9502).
        covariance_scale: factor on the covariance of independent residuals, as in scan matching.
        scale: of the scene; in rooms below 1, and starts of a search are as much nearer to each other.
        map_sigmas: errors of the map at one place, in rad and m, of which a scan's points see the same ones.
        registration: kernel, distances, limits.

    Raises:
        SettingError: a value is out of range.
    """

    min_points: int = 50
    min_matched: float = 0.6
    max_cost: float = 0.5
    min_above_ground: int = 50
    min_matched_above: float = 0.7
    max_cost_above: float = 0.5
    covariance_scale: float = 5.0
    scale: float = 1.0
    map_sigmas: tuple[float, float] = (2e-4, 0.005)
    registration: RegistrationSettings = field(default_factory=RegistrationSettings)

    def __post_init__(self) -> None:
        check_positive(self, "covariance_scale", "scale")
        check_not_negative(self, "min_points", "min_above_ground")
        check_fraction(self, "min_matched", "max_cost", "min_matched_above", "max_cost_above")


@dataclass(frozen=True, eq=False)
class MapMatch:
    """The result of matching a scan with the map.

    Attributes:
        found: the scan's pose in the map, with the error of the map.
        matched: share of points with a surface of the map nearby.
        cost: mean robust cost of the points, 0 to 1.
        holds: whether enough of the scan fits the map.
    """

    found: UncertainPose
    matched: float
    cost: float
    holds: bool


def match_with_map(
    map_surface: MapSurface,
    scan: ThinnedScan,
    predicted: UncertainPose,
    settings: MapMatchingSettings,
    is_in_question: bool = False,
) -> MapMatch | None:
    """Register a scan to the map from a predicted pose; None where the map has no surface or the scan no points.

    Args:
        map_surface: of the map.
        scan: motion compensated.
        predicted: pose of the scan in the map.
        settings: limits.
        is_in_question: whether the scan may be at another place; then the points above the ground must fit too.
    """
    surface = map_surface.around(predicted.pose[:3, 3])
    if surface is None or len(scan.points) < settings.min_points:
        return None
    start, kernel_start_m = predicted.pose, _kernel_start_m(predicted, settings)
    if kernel_start_m >= settings.registration.max_distance_m:
        start = _search(surface, scan, predicted, settings)
    problem = RegistrationProblem(surface, scan.source, settings.registration, scan.points)
    observed = register_with_degeneracy(problem, start, kernel_start_m)
    found = observed.registration
    covariance = observed.covariance(settings.covariance_scale) + _map_error(settings)
    holds = found.matched >= settings.min_matched and found.cost <= settings.max_cost
    holds = holds and (not is_in_question or _fits_above_ground(surface, scan, found.pose, settings))
    return MapMatch(UncertainPose(found.pose, covariance), found.matched, found.cost, holds)


def _kernel_start_m(predicted: UncertainPose, settings: MapMatchingSettings) -> float:
    sideways_m = settings.scale * POINT_LEVER_M * float(np.sqrt(predicted.covariance[:3, :3].trace()))
    registration = settings.registration
    return min(max(registration.kernel_m, predicted.sigma_m, sideways_m), registration.max_distance_m)


def _search(surface: Surface, scan: ThinnedScan, predicted: UncertainPose, settings: MapMatchingSettings) -> Array:
    """Return the best start within twice the standard deviations of a prediction."""
    sigmas = np.sqrt(np.diag(predicted.covariance))
    lengths = np.array([1.0, settings.scale, settings.scale])
    reach = np.minimum(2 * sigmas[[2, 3, 4]], lengths * _SEARCHED)
    counts = np.minimum(2 * np.ceil(reach / (lengths * _SEARCH_STEPS)).astype(int) + 1, _MAX_STEPS)
    grids = (np.linspace(-most, most, count) for most, count in zip(reach, counts, strict=True))
    starts = [predicted.pose @ se3.exp(np.array([0, 0, yaw, x, y, 0])) for yaw, x, y in product(*grids)]
    few, sparse = scan.source[::_JUDGED_STRIDE], scan.source[::_SPARSE]
    search = replace(_SEARCH, kernel_m=settings.scale * _SEARCH.kernel_m)
    found = refine_best(surface, few, sparse, starts, settings.registration, search)
    return min(found, key=lambda one: one.cost).pose


def _fits_above_ground(surface: Surface, scan: ThinnedScan, pose: Array, settings: MapMatchingSettings) -> bool:
    """Return whether the points whose surface is not horizontal fit the map."""
    registration = settings.registration
    index, _ = surface.nearest(se3.transform(pose, scan.points), registration.threads)
    above = scan.points[np.abs(surface.normals[index][:, 2]) <= HORIZONTAL]
    if len(above) < settings.min_above_ground:
        return False
    fit = fit_at(surface, above, pose, registration.kernel_m, registration.threads, registration.max_distance_m)
    return fit.matched >= settings.min_matched_above and fit.cost <= settings.max_cost_above


def _map_error(settings: MapMatchingSettings) -> Array:
    rad, metres = settings.map_sigmas
    return np.diag(np.repeat([rad, metres], 3) ** 2)
