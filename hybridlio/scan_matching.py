"""The classical residual source: registration of each scan to the last one, or to a map of recent keyframes."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import product
from typing import Literal

import numpy as np

from hybridlio import se3
from hybridlio.errors import DataError
from hybridlio.estimates import Array, RelativePose
from hybridlio.information import FLOOR_SIGMAS, covariance_of, degenerate_directions
from hybridlio.local_map import LocalMap, LocalMapSettings
from hybridlio.registration import Registration, RegistrationSettings, Surface, cost_at, register
from hybridlio.sensors import NS_PER_S, Frame, Scan
from hybridlio.voxel import voxel_average


@dataclass(frozen=True)
class ScanMatchingSettings:
    """How scans are matched.

    Attributes:
        target: ``local-map`` of recent keyframes, or the ``last-scan`` alone.
        min_range_m, max_range_m: points outside are not used.
        map_voxel_m: side of the voxels that thin a scan for the map.
        source_voxel_m: the same for the points that are registered.
        min_points: with fewer points a scan is bridged by the initial pose.
        min_matched: with a smaller share of points matched, too.
        covariance_scale: how much larger the covariance is than independent residuals would make it; points on one
            surface share its error.
        drift_share: how much of a step's covariance adds up when the map has taken in a keyframe, once it has many;
            the rest is scatter about the map. Not used with ``last-scan``, where all of it does.
        start_speeds_m_s: forward speeds tried where the initial pose is unsure of the translation.
        start_rates_deg_s: rates of turn tried with each where it is unsure of the rotation too.
    """

    __pydantic_config__ = {"extra": "forbid"}  # noqa: RUF012  (read from YAML: unknown keys are errors)

    target: Literal["local-map", "last-scan"] = "local-map"
    min_range_m: float = 2.0
    max_range_m: float = 100.0
    map_voxel_m: float = 0.6
    source_voxel_m: float = 1.0
    min_points: int = 200
    min_matched: float = 0.3
    covariance_scale: float = 6.0
    drift_share: float = 0.1
    start_speeds_m_s: tuple[float, ...] = (0.0, -5.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0)
    start_rates_deg_s: tuple[float, ...] = (0.0, -50.0, 50.0, -100.0, 100.0)
    registration: RegistrationSettings = field(default_factory=RegistrationSettings)
    local_map: LocalMapSettings = field(default_factory=LocalMapSettings)


_UNSURE_TRANSLATION_M = 0.5
_UNSURE_ROTATION_RAD = 0.02
_SPARSE = 8  # one in so many points is enough to tell a metre from another
_COARSE_ITERATIONS = 6
_LIKELY = 12
_COARSE_KERNEL_M = 0.5
_SHARE_OF_SAME_MAP = 1e-3
_YOUNG_MAP = 5.0  # a map of one keyframe has ground only along that scan's rings, and guesses what lies between
_FLOOR_COVARIANCE = np.diag(FLOOR_SIGMAS**2)


class ScanMatching:
    """Registers each scan from its initial pose. Its own path starts at the first scan and is never sent back to it."""

    name = "scan-matching"

    def __init__(self, settings: ScanMatchingSettings | None = None) -> None:
        self._settings = settings or ScanMatchingSettings()
        self._map = LocalMap(self._settings.local_map)
        self._T_map_lidar: Array = np.eye(4)
        self._stamp_ns = 0
        self._map_changed = False  # since the last scan was matched

    def start(self, frame: Frame) -> None:
        """Make the first scan the map.

        Raises:
            DataError: it has too few points.
        """
        points = self._thin(frame.scan)
        if len(points) < self._settings.min_points:
            raise DataError(
                f"frame {frame.index}: only {len(points)} points between {self._settings.min_range_m} and "
                f"{self._settings.max_range_m} m; start at a scan with at least {self._settings.min_points}"
            )
        self._map = LocalMap(self._settings.local_map)
        self._T_map_lidar = np.eye(4)
        self._keep(points)
        self._stamp_ns = frame.scan.stamp_ns

    def refine(self, frame: Frame, initial: RelativePose) -> RelativePose:
        """Register the scan; where that fails, return the initial pose marked as not ok."""
        points = self._thin(frame.scan)
        dt_s = (frame.scan.stamp_ns - self._stamp_ns) / NS_PER_S
        self._stamp_ns = frame.scan.stamp_ns
        found = self._register(points, initial, dt_s) if len(points) >= self._settings.min_points else None
        if found is None or found.matched < self._settings.min_matched:
            return self._bridge(initial, len(points), found)
        before, self._T_map_lidar = self._T_map_lidar, found.pose
        map_changed, self._map_changed = self._map_changed, False
        if self._settings.target == "last-scan" or self._map.wants(found.pose):
            self._keep(points)
        scale = self._settings.covariance_scale * (1 + _YOUNG_MAP / self._map.keyframes)
        covariance = covariance_of(found.hessian, found.sigma_m, scale)
        return RelativePose(
            se3.between(before, found.pose),
            covariance,
            source=self.name,
            drift=self._drift(covariance, map_changed),
            degenerate=degenerate_directions(found.hessian),
            details=_details(found, len(points)),
        )

    def _drift(self, covariance: Array, map_changed: bool) -> Array | None:
        """What of a step's covariance adds up: at first much, for a map of few keyframes is as wrong as they are."""
        if self._settings.target == "last-scan":
            return None
        share = max(self._settings.drift_share, 0.5 / self._map.keyframes) if map_changed else _SHARE_OF_SAME_MAP
        return share * covariance

    def _thin(self, scan: Scan) -> Array:
        """``(M, 3)``: one point a voxel, of those within range."""
        points = voxel_average(scan.points, None, self._settings.map_voxel_m)[0].astype(np.float64)
        range2 = np.einsum("ij,ij->i", points, points)
        near, far = self._settings.min_range_m, self._settings.max_range_m
        return np.asarray(points[(range2 > near**2) & (range2 < far**2)])

    def _keep(self, points: Array) -> None:
        if self._settings.target == "last-scan":
            self._map = LocalMap(self._settings.local_map)
        self._map.insert(points, self._T_map_lidar)
        self._map_changed = True

    def _register(self, points: Array, initial: RelativePose, dt_s: float) -> Registration | None:
        surface = self._map.surface
        if surface is None:
            return None
        source = voxel_average(points, None, self._settings.source_voxel_m)[0].astype(np.float64)
        settings = self._settings.registration
        sigma_m = float(np.sqrt(initial.covariance[3:, 3:].trace()))
        kernel_start_m = min(max(settings.kernel_m, sigma_m), 1.0)
        start = self._T_map_lidar @ initial.pose
        if sigma_m > _UNSURE_TRANSLATION_M:
            turns = initial.covariance[:3, :3].trace() > _UNSURE_ROTATION_RAD**2
            start = self._search(surface, source, start, dt_s, self._settings.start_rates_deg_s if turns else (0.0,))
        return register(surface, source, start, settings, kernel_start_m)

    def _search(
        self, surface: Surface, source: Array, start: Array, dt_s: float, rates_deg_s: tuple[float, ...]
    ) -> Array:
        """The best of several motions: all are judged by a few of the points, the likelier ones after a few steps."""
        sparse, settings = source[::_SPARSE], self._settings.registration
        motions = product(self._settings.start_speeds_m_s, np.deg2rad(rates_deg_s))
        starts = [start @ se3.exp(np.array([0, 0, rate, speed, 0, 0]) * dt_s) for speed, rate in motions]
        starts.sort(key=lambda T: cost_at(surface, sparse, T, _COARSE_KERNEL_M, settings.threads))
        coarse = replace(settings, max_iterations=_COARSE_ITERATIONS)
        tries = [register(surface, sparse, T, coarse, _COARSE_KERNEL_M) for T in starts[:_LIKELY]]
        return min(tries, key=lambda found: found.cost).pose

    def _bridge(self, initial: RelativePose, points: int, found: Registration | None) -> RelativePose:
        self._T_map_lidar = self._T_map_lidar @ initial.pose
        return RelativePose(
            initial.pose,
            initial.covariance,
            source=initial.source,
            ok=False,
            drift=self._drift(_FLOOR_COVARIANCE, map_changed=False),  # the map has not moved
            from_imu=initial.from_imu,
            details=_details(found, points) if found else {"points": float(points)},
        )


def _details(found: Registration, points: int) -> dict[str, float]:
    return {
        "points": float(points),
        "matched": found.matched,
        "iterations": float(found.iterations),
        "converged": float(found.converged),
        "sigma_m": found.sigma_m,
        "cost": found.cost,
    }
