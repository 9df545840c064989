"""The settings of a map."""

from __future__ import annotations

from dataclasses import dataclass

from hybridlio.core.setting_checks import check_not_negative, check_positive, check_setting


@dataclass(frozen=True)
class MapSettings:
    """What goes into a map, and how fine it is.

    Attributes:
        voxel_m: side of the voxels; the map has one point, the mean, for each voxel that scans hit.
        min_range_m, max_range_m: points nearer or farther than this from the lidar are left out. The direction of a
            far point is as uncertain as the pose's rotation: at 100 m, 1 mrad moves it by 0.1 m, one voxel.
        remove_moving: remove points of objects that were there for a while only: later or earlier scans see through
            them.
        normals: estimate a normal for each point.
        tile_m: side of the tiles in which the map is computed, kept and, as a folder, written.
        max_resident_voxels: voxels kept in memory while scans are added, at about 60 bytes each; the others wait on
            disk.

    Raises:
        SettingError: a value is out of range.
    """

    __pydantic_config__ = {"extra": "forbid"}  # noqa: RUF012  (read from YAML: unknown keys are errors)

    voxel_m: float = 0.1  # a few times the noise of a range, 2 cm
    min_range_m: float = 1.5  # the roof and the people around the sensor
    max_range_m: float = 100.0
    remove_moving: bool = True
    normals: bool = True
    tile_m: float = 50.0
    max_resident_voxels: int = 20_000_000

    def __post_init__(self) -> None:
        check_positive(self, "voxel_m", "max_range_m", "tile_m", "max_resident_voxels")
        check_not_negative(self, "min_range_m")
        check_setting(self, "max_range_m", self.max_range_m > self.min_range_m, f"above min_range_m {self.min_range_m}")
        check_setting(self, "tile_m", self.tile_m >= 10 * self.voxel_m, f"at least ten voxels of {self.voxel_m} m")
