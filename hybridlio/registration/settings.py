"""Settings of registration and of the local map. This module imports no algorithm, so that settings load quickly."""

from __future__ import annotations

from dataclasses import dataclass

from hybridlio.cloud.plane_fitting import MIN_NEIGHBOURS
from hybridlio.core.setting_checks import check_positive, check_setting

_MAX_NEIGHBOURS = 1000  # at spacings of 0.1 m a disc of 1.8 m radius, which is no place on a surface any more

MATCH_KERNELS = 3  # kernel widths within which neighbours count; the weight of a residual beyond is below 1 %


@dataclass(frozen=True)
class RegistrationSettings:
    """Settings of a registration.

    Attributes:
        kernel_m: width of the Geman-McClure kernel: the residual at which a match has a quarter of its weight.
        max_distance_m: nearest neighbours farther away are not matched.
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


@dataclass(frozen=True)
class LocalMapSettings:
    """Settings of the local map.

    Attributes:
        keyframe_m, keyframe_deg: a scan this far from the last keyframe, or turned by this much, becomes a keyframe.
        voxel_m: side of the map's cells; each holds up to ten points.
        spacing_m: a point nearer than this to one of an earlier keyframe is not added.
        horizon_keyframes: a cell that this number of keyframes has not hit is dropped at the next rebuild.
        radius_m: points farther from the keyframe are left out of the surface at a rebuild.
        neighbours: number of points that a plane is fitted to.
        one_sided: match planes only from the side that they were seen from. Walls of rooms are seen from both sides. In
            streets it is trunks that are, whose planes are worth matching from any side: in an open field with trees
            the drift is a third larger without them.
        threads: for planes and trees.

    Raises:
        SettingError: a value is out of range.
    """

    __pydantic_config__ = {"extra": "forbid"}  # noqa: RUF012  (read from YAML: unknown keys are errors)

    keyframe_m: float = 2.0
    keyframe_deg: float = 10.0
    voxel_m: float = 2.0
    spacing_m: float = 0.1
    horizon_keyframes: int = 30
    radius_m: float = 100.0
    neighbours: int = 10
    one_sided: bool = False
    threads: int = 2

    def __post_init__(self) -> None:
        check_positive(
            self, "keyframe_m", "keyframe_deg", "voxel_m", "spacing_m", "horizon_keyframes", "radius_m", "threads"
        )
        check_setting(
            self, "neighbours", MIN_NEIGHBOURS <= self.neighbours <= _MAX_NEIGHBOURS,
            f"from {MIN_NEIGHBOURS}, as a plane needs, to {_MAX_NEIGHBOURS}",
        )  # fmt: skip
