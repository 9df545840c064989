"""Settings of scan matching."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from hybridlio.core.setting_checks import check_fraction, check_not_negative, check_positive, check_setting
from hybridlio.registration.icp import RegistrationSettings
from hybridlio.registration.local_map import LocalMapSettings


@dataclass(frozen=True)
class ScanMatchingSettings:
    """How scans are matched.

    Attributes:
        target: ``local-map`` of recent keyframes, or the ``last-scan`` alone.
        min_range_m, max_range_m: points outside are not used.
        map_voxel_m: side of the voxels that thin a scan for the map.
        source_voxel_m: the same for the points that are registered.
        least_measured: where these stand for fewer measured points, as with a sensor of few beams, voxels are smaller.
        min_points: with fewer points a scan is bridged by the initial pose.
        min_matched: with a smaller share of points matched, too.
        covariance_scale: how much larger the covariance is than independent residuals would make it; points on one
            surface share its error.
        drift_share: how much of a step's covariance adds up when the map has taken in a keyframe, once it has many;
            the rest is scatter about the map. Not used with ``last-scan``, where all of it does.
        start_speeds_m_s: forward speeds tried where the initial pose is unsure of the translation.
        start_rates_deg_s: rates of turn tried with each where it is unsure of the rotation too.

    Raises:
        SettingError: a value is out of range.
    """

    __pydantic_config__ = {"extra": "forbid"}  # noqa: RUF012  (read from YAML: unknown keys are errors)

    target: Literal["local-map", "last-scan"] = "local-map"
    min_range_m: float = 2.0
    max_range_m: float = 100.0
    map_voxel_m: float = 0.6
    source_voxel_m: float = 1.0
    least_measured: int = 20_000
    min_points: int = 200
    min_matched: float = 0.3
    covariance_scale: float = 5.0
    drift_share: float = 0.1
    start_speeds_m_s: tuple[float, ...] = (0.0, -5.0, *(2.5 * i for i in range(1, 17)))
    start_rates_deg_s: tuple[float, ...] = (0.0, -50.0, 50.0, -100.0, 100.0)
    registration: RegistrationSettings = field(default_factory=RegistrationSettings)
    local_map: LocalMapSettings = field(default_factory=LocalMapSettings)

    def __post_init__(self) -> None:
        check_setting(self, "target", self.target in ("local-map", "last-scan"), "local-map or last-scan")
        check_positive(self, "map_voxel_m", "source_voxel_m", "covariance_scale")
        check_not_negative(self, "min_range_m", "min_points", "least_measured")
        check_fraction(self, "min_matched", "drift_share")
        check_setting(
            self, "max_range_m", self.max_range_m > self.min_range_m, f"above min_range_m, {self.min_range_m}"
        )
        for name in ("start_speeds_m_s", "start_rates_deg_s"):
            check_setting(self, name, len(getattr(self, name)) > 0, "one number at least")
