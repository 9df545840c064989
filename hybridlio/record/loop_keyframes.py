"""Loop keyframes: a thinned cloud every few metres, stored beside a run's record for loop closure after the run.

They are independent of the keyframes of the local map, which registration uses during the run.

A point takes six bytes, so a kilometre takes at most ``1000 / spacing_m · max_points · 6`` bytes: 7.5 MB with the
default settings. Packed in memory during a run it takes five ninths of that; the file takes about half.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybridlio.cloud.voxel import voxel_average
from hybridlio.core.arrays import Array, Floats, Index, Stamps
from hybridlio.core.errors import DataError
from hybridlio.core.files import UNREADABLE_NPZ, atomic_path, opened_npz
from hybridlio.core.sensors import Scan
from hybridlio.core.setting_checks import check_positive, check_setting
from hybridlio.record.packed_arrays import PackedCloud

FORMAT_VERSION = 1  # stored in the file; other versions are rejected
RESOLUTION_M = 0.005  # a quarter of a lidar's range noise; int16 then reaches 164 m
_LARGEST_RANGE_M = RESOLUTION_M * np.iinfo(np.int16).max
_AVERAGED_POINTS = 30_000  # more points per scan take longer and move the voxel means only by millimetres
_MIN_POINTS = 200  # fewer voxels, such as from a blocked lidar, cannot be registered
_MAX_PACKING_STEP = 256  # a position within a cell must fit a byte


@dataclass(frozen=True)
class LoopKeyframeSettings:
    """Which scans are kept, and how they are thinned.

    The defaults trade size for detail: voxels of 0.7 m keep walls and trunks, an HDL-64E has few returns beyond 80 m,
    and clouds 4 m apart overlap almost completely.

    Attributes:
        spacing_m: distance from the last keyframe at which a scan becomes the next.
        voxel_m: side of the voxels in which points are averaged.
        max_range_m: points farther from the lidar are left out.
        max_points: a cloud with more points is thinned evenly to this number.

    Raises:
        SettingError: a value is out of range.
    """

    __pydantic_config__ = {"extra": "forbid"}  # noqa: RUF012  (read from YAML: unknown keys are errors)

    spacing_m: float = 4.0
    voxel_m: float = 0.7
    max_range_m: float = 80.0
    max_points: int = 5000

    def __post_init__(self) -> None:
        check_positive(self, "spacing_m", "voxel_m", "max_points")
        within = 0 < self.max_range_m < _LARGEST_RANGE_M
        check_setting(self, "max_range_m", within, f"above 0 and below {_LARGEST_RANGE_M:.0f}")


PackedKeyframe = tuple[int, int, PackedCloud]  # row, stamp, points


@dataclass(frozen=True, eq=False)
class LoopKeyframes:
    """The loop keyframes of a run.

    Attributes:
        rows: ``(K,)`` int64, ascending; index of each keyframe among the run's estimates.
        stamps_ns: ``(K,)`` int64.
        clouds: ``K`` arrays ``(n, 3)`` int16, lidar frame at the stamp, in units of :data:`RESOLUTION_M`.

    Raises:
        DataError: lengths differ, rows do not ascend, or a cloud has another shape or type.
    """

    rows: Index
    stamps_ns: Stamps
    clouds: tuple[NDArray[np.int16], ...]

    def __post_init__(self) -> None:
        rows, stamps = np.asarray(self.rows, np.int64), np.asarray(self.stamps_ns, np.int64)
        if not rows.shape == stamps.shape == (len(self.clouds),):
            raise DataError(
                f"loop keyframes: {len(self.clouds)} clouds do not match rows {rows.shape} and stamps {stamps.shape}"
            )
        if (np.diff(rows) <= 0).any() or (len(rows) and rows[0] < 0):
            raise DataError("loop keyframes: rows must ascend from 0 or more")
        if any(cloud.dtype != np.int16 or cloud.ndim != 2 or cloud.shape[1] != 3 for cloud in self.clouds):
            raise DataError("loop keyframes: clouds must be (n, 3) int16")
        object.__setattr__(self, "rows", rows)
        object.__setattr__(self, "stamps_ns", stamps)

    def __len__(self) -> int:
        return len(self.rows)

    def until(self, row: int) -> LoopKeyframes:
        """Return the keyframes among the estimates before ``row``."""
        count = int(np.searchsorted(self.rows, row))
        return LoopKeyframes(self.rows[:count], self.stamps_ns[:count], self.clouds[:count])

    def points(self, k: int) -> Array:
        """Return the points ``(n, 3)`` of keyframe ``k`` in metres, lidar frame."""
        return self.clouds[k].astype(np.float64) * RESOLUTION_M

    def save(self, path: Path) -> None:
        """Write the keyframes to one ``.npz`` file of plain arrays."""
        counts = np.array([len(cloud) for cloud in self.clouds], dtype=np.int64)
        points = np.concatenate([np.empty((0, 3), np.int16), *self.clouds])
        with atomic_path(path) as part, part.open("wb") as file:
            np.savez_compressed(
                file, allow_pickle=False, version=np.int64(FORMAT_VERSION), resolution_m=np.float64(RESOLUTION_M),
                rows=self.rows, stamps_ns=self.stamps_ns, counts=counts, points=points,
            )  # fmt: skip

    @classmethod
    def load(cls, path: Path) -> LoopKeyframes:
        """Read keyframes written by :meth:`save`; never executes anything in the file.

        Raises:
            DataError: the file is missing, holds no loop keyframes, or has another format version.
        """
        if not path.is_file():
            raise DataError(f"{path}: the run has no keyframes for loop closure; run `hybridlio odometry` again")
        try:
            with opened_npz(path) as file:
                version, resolution_m = int(file["version"]), float(file["resolution_m"])
                if version != FORMAT_VERSION or resolution_m != RESOLUTION_M:
                    raise ValueError(f"format version {version}, this release reads {FORMAT_VERSION}")
                counts, points = file["counts"], file["points"]
                if counts.ndim != 1 or (counts < 0).any() or counts.sum() != len(points):
                    raise ValueError(f"counts add up to {int(counts.sum())}, but there are {len(points)} points")
                ends = np.cumsum(counts)
                clouds = tuple(points[end - count : end] for end, count in zip(ends, counts, strict=True))
                return cls(file["rows"], file["stamps_ns"], clouds)
        except UNREADABLE_NPZ as error:
            raise DataError(
                f"{path}: not the loop keyframes of a run ({error}); run `hybridlio odometry` again"
            ) from error


class LoopKeyframeSelector:
    """Selects loop keyframes: takes the scans of a run in order and keeps one every few metres."""

    def __init__(self, settings: LoopKeyframeSettings) -> None:
        self._settings = settings
        self._position: Array | None = None
        self._kept: list[PackedKeyframe] = []
        self._step = min(max(round(settings.voxel_m / RESOLUTION_M), 1), _MAX_PACKING_STEP)

    def offer(self, row: int, scan: Scan, pose: Array) -> bool:
        """Keep the scan if it is far enough from the last one kept and has enough points.

        Args:
            row: the scan's index among the run's estimates.
            scan: the scan after motion compensation.
            pose: ``(4, 4)`` ``T_world_lidar``, from which the distance is computed.

        Returns:
            Whether the scan was kept.
        """
        position = pose[:3, 3]
        if self._position is not None and np.linalg.norm(position - self._position) < self._settings.spacing_m:
            return False
        cloud = compress(scan.points, self._settings)
        if len(cloud) < _MIN_POINTS:
            return False
        self._kept.append((row, scan.stamp_ns, PackedCloud.of(cloud, self._step)))
        self._position = position.copy()
        return True

    def kept_since(self, row: int) -> list[PackedKeyframe]:
        """Return the keyframes among the estimates from ``row`` on."""
        return [kept for kept in self._kept if kept[0] >= row]

    def restore(self, kept: Iterable[PackedKeyframe], position: Array | None) -> None:
        """Continue after these keyframes; ``position`` ``(3,)`` is that of the last one, None without any."""
        self._kept, self._position = list(kept), position

    @property
    def last_position(self) -> Array | None:
        """``(3,)`` position of the last keyframe, None before the first."""
        return self._position

    def keyframes(self) -> LoopKeyframes:
        """Return all keyframes kept so far."""
        return unpacked(self._kept)


def unpacked(kept: Sequence[PackedKeyframe]) -> LoopKeyframes:
    """Return packed keyframes as they go into the file."""
    rows, stamps = (np.array([one[i] for one in kept], np.int64) for i in (0, 1))
    return LoopKeyframes(rows, stamps, tuple(cloud.cloud() for _, _, cloud in kept))


def compress(points: Floats, settings: LoopKeyframeSettings) -> NDArray[np.int16]:
    """Average the points ``(N, 3)`` within range by voxel; ``(n, 3)`` int16 in units of :data:`RESOLUTION_M`."""
    some = points[:: max(1, len(points) // _AVERAGED_POINTS)]
    some = some[np.einsum("ij,ij->i", some, some) < np.float32(settings.max_range_m) ** 2]
    thinned = voxel_average(some, None, settings.voxel_m)[0]
    if len(thinned) > settings.max_points:
        thinned = thinned[np.linspace(0, len(thinned) - 1, settings.max_points).astype(np.intp)]
    return np.round(thinned / np.float32(RESOLUTION_M)).astype(np.int16)
