"""Settings of the classical sources. This module imports no algorithm, so that settings load quickly."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from hybridlio.core.setting_checks import check_fraction, check_not_negative, check_positive, check_setting
from hybridlio.registration.settings import LocalMapSettings, RegistrationSettings

# Median range of the points in the smallest scene that the default lengths suit: two thirds of the shortest of six
# simulated road drives, 18 m.
STREET_VIEW_M = 12.0
_MAX_SCALE = 1e6  # of a covariance: its standard deviations a thousand times too large, and registration says nothing


@dataclass(frozen=True)
class ScanMatchingSettings:
    """How scans are matched.

    Attributes:
        scene_scale: factor on the default lengths and speeds below, which hold for streets. By default it follows from
            the scans, see :mod:`hybridlio.sources.scene_scale`; 1 keeps the defaults everywhere. A length that is not
            the default is used as it is.
        target: what a scan is matched to: the ``local-map`` of recent keyframes, or the ``last-scan`` alone.
        min_range_m, max_range_m: points nearer or farther are dropped.
        map_voxel_m: side of the voxels that a scan is averaged over for the map.
        source_voxel_m: side of the voxels of which one point each is registered.
        least_measured: if the points to register are averages over fewer measured points in all, as with a sensor of
            few beams, smaller voxels are used for them.
        min_points: a scan with fewer points is bridged by the initial pose.
        min_matched: a scan with a smaller fraction of points matched is bridged as well.
        covariance_scale: factor on the covariance of independent residuals, because points on one surface share its
            error.
        drift_share: fraction of a step's covariance that adds up over steps when the map, once it is old, gets a
            keyframe; the rest is scatter about the map. With ``last-scan`` all of it adds up.
        start_speeds_m_s: forward speeds that are tried if the initial pose does not know the translation.
        start_rates_deg_s: yaw rates that are tried with each speed if it does not know the rotation either.
        registration: settings of the registration.
        local_map: settings of the local map.

    Raises:
        SettingError: a value is out of range.
    """

    __pydantic_config__ = {"extra": "forbid"}  # noqa: RUF012  (read from YAML: unknown keys are errors)

    target: Literal["local-map", "last-scan"] = "local-map"
    scene_scale: float | None = None
    min_range_m: float = 2.0
    max_range_m: float = 100.0
    map_voxel_m: float = 0.6
    source_voxel_m: float = 1.0
    least_measured: int = 20_000
    min_points: int = 50
    min_matched: float = 0.3
    covariance_scale: float = 5.0
    drift_share: float = 0.1
    start_speeds_m_s: tuple[float, ...] = (0.0, -5.0, *(2.5 * i for i in range(1, 17)))
    start_rates_deg_s: tuple[float, ...] = (0.0, -50.0, 50.0, -100.0, 100.0)
    registration: RegistrationSettings = field(default_factory=RegistrationSettings)
    local_map: LocalMapSettings = field(default_factory=LocalMapSettings)

    def __post_init__(self) -> None:
        check_setting(self, "target", self.target in ("local-map", "last-scan"), "local-map or last-scan")
        if self.scene_scale is not None:
            check_setting(self, "scene_scale", 0 < self.scene_scale <= 1, "above 0 and at most 1")
        check_positive(self, "map_voxel_m", "source_voxel_m", "covariance_scale")
        check_setting(self, "covariance_scale", self.covariance_scale <= _MAX_SCALE, f"at most {_MAX_SCALE:g}")
        check_not_negative(self, "min_range_m", "min_points", "least_measured")
        check_fraction(self, "min_matched", "drift_share")
        check_setting(
            self, "max_range_m", self.max_range_m > self.min_range_m, f"above min_range_m, {self.min_range_m}"
        )
        for name in ("start_speeds_m_s", "start_rates_deg_s"):
            check_setting(self, name, len(getattr(self, name)) > 0, "a list of one number or more")


@dataclass(frozen=True)
class RecentScansSettings:
    """Which recent scans each scan is compared with.

    Attributes:
        count: number of recent scans; 0 compares with the last scan only.
        distance_m, angle_deg: a scan this far from the newest recent scan becomes one itself.
        shared: fraction of a relative pose's covariance that is noise of its two scans, half each, and so is shared by
            all relative poses of a scan.

    Raises:
        SettingError: a value is out of range.
    """

    __pydantic_config__ = {"extra": "forbid"}  # noqa: RUF012  (read from YAML: unknown keys are errors)

    count: int = 0
    distance_m: float = 3.0
    angle_deg: float = 15.0
    shared: float = 0.75

    def __post_init__(self) -> None:
        check_not_negative(self, "count")
        check_positive(self, "distance_m", "angle_deg")
        check_setting(self, "shared", 0 <= self.shared < 1, "from 0 to below 1")
