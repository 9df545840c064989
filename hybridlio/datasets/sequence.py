"""What a reader returns: a recording as a sequence of frames, scans loaded when asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hybridlio.errors import DataError
from hybridlio.sensors import Calibration, Frame, GpsFix, ImuSamples, LidarModel, Scan
from hybridlio.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class Sequence:
    """A recording.

    Attributes:
        name: short name for tables and run folders.
        stamps_ns: ``(N,)`` int64, one per scan, strictly increasing.
        load_scan: gives scan ``k`` of ``N``; called each time a frame is asked for.
        imu: every inertial sample; empty where there are none.
        calibration: the extrinsics.
        reference: ground truth lidar poses in the first scan's frame, one per scan, or None.
        gps: fixes in time order.
        lidar: the sensor, where known; decides the vertex map's limits.
        pose_file_frame: ``lidar`` or ``camera``: the frame that KITTI pose files of this recording use.
    """

    name: str
    stamps_ns: NDArray[np.int64]
    load_scan: Callable[[int], Scan]
    imu: ImuSamples = field(default_factory=ImuSamples.empty)
    calibration: Calibration = field(default_factory=Calibration)
    reference: Trajectory | None = None
    gps: tuple[GpsFix, ...] = ()
    lidar: LidarModel | None = None
    pose_file_frame: str = "lidar"

    def __post_init__(self) -> None:
        if not len(self.stamps_ns):
            raise DataError(f"{self.name}: no scans")
        backwards = np.diff(self.stamps_ns) <= 0
        if backwards.any():
            raise DataError(f"{self.name}: scan stamps do not increase at scan {int(backwards.argmax()) + 1}")

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def __getitem__(self, index: int) -> Frame:
        """Frame ``index`` (negative counts from the end), its scan read now."""
        k = range(len(self))[index]
        previous = self.stamps_ns[k - 1] if k else self.imu.stamps_ns[0] if len(self.imu) else self.stamps_ns[0]
        start, end = int(previous), int(self.stamps_ns[k])
        gps = tuple(fix for fix in self.gps if start < fix.stamp_ns <= end)
        return Frame(k, self.load_scan(k), self.imu.between(start, end), gps)

    def __iter__(self) -> Iterator[Frame]:
        return (self[k] for k in range(len(self)))
