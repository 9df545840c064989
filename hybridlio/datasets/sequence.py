"""What a reader returns: a recording as a sequence of frames, scans loaded when asked for."""

from __future__ import annotations

import logging
from bisect import bisect_right
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from hybridlio.core.errors import ConfigError, DataError
from hybridlio.core.sensors import NS_PER_S, Calibration, Frame, GpsFix, ImuNoise, ImuSamples, LidarModel, Scan
from hybridlio.core.trajectory import Trajectory

_log = logging.getLogger(__name__)


@dataclass
class Notes:
    """Remarks on what is unusual in a recording: each is logged as a warning once, and kept with the sequence."""

    name: str
    texts: list[str] = field(default_factory=list)

    def add(self, text: str) -> None:
        """Log and keep one remark."""
        if text not in self.texts:
            self.texts.append(text)
            _log.warning("%s: %s", self.name, text)


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
        forward_speed_m_s: ``(N,)`` the vehicle's speed at the scans as its own navigation system gives it, or None;
            for judging a trajectory's length where positions are poor.
        imu_noise: the IMU's noise where the recording says it.
        notes: what was found unusual when opening (gaps, dropped stamps, substitutes); also logged then.
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
    forward_speed_m_s: NDArray[np.float64] | None = None
    imu_noise: ImuNoise | None = None
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not len(self.stamps_ns):
            raise DataError(f"{self.name}: no scans")
        backwards = np.diff(self.stamps_ns) <= 0
        if backwards.any():
            raise DataError(f"{self.name}: scan stamps do not increase at scan {int(backwards.argmax()) + 1}")
        for what, values in (("reference", self.reference), ("forward_speed_m_s", self.forward_speed_m_s)):
            if values is not None and len(values) != len(self.stamps_ns):
                raise DataError(f"{self.name}: {what} has {len(values)} entries for {len(self.stamps_ns)} scans")
        if any(a.stamp_ns > b.stamp_ns for a, b in zip(self.gps, self.gps[1:], strict=False)):
            raise DataError(f"{self.name}: GPS fixes are not in time order; sort them by stamp")

    def __repr__(self) -> str:
        return f"Sequence({self.name!r}, {len(self)} scans, {len(self.imu)} inertial samples)"

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def __getitem__(self, index: int) -> Frame:
        """Frame ``index`` (negative counts from the end), its scan read now.

        Raises:
            DataError: the scan cannot be read; :meth:`without_scan` gives the frame all the same.
        """
        k = range(len(self))[index]
        return self._frame(k, self.load_scan(k))

    def without_scan(self, index: int) -> Frame:
        """Frame ``index`` with a scan of no points, for going on where the scan cannot be read."""
        k = range(len(self))[index]
        return self._frame(k, Scan(int(self.stamps_ns[k]), np.empty((0, 3), np.float32)))

    def part(self, start: int | None, stop: int | None) -> Sequence:
        """Frames ``start`` to before ``stop`` as a sequence of its own, counted from 0, in its first scan's frame.

        All inertial samples are kept: those before the first scan help to find where down is.

        Raises:
            DataError: no frame is left.
        """
        rows = slice(*slice(start, stop).indices(len(self))[:2])
        if rows.start >= rows.stop:
            ends = f"{'' if start is None else start}:{'' if stop is None else stop}"
            raise DataError(f"{self.name}: no scans in {ends}; there are {len(self)}")
        before = int(self.stamps_ns[rows.start - 1]) if rows.start else self._first_stamp_ns() - 1
        reference = self.reference
        if reference is not None:
            reference = Trajectory(reference.stamps_ns[rows], reference.poses[rows]).from_first()
        return replace(
            self,
            stamps_ns=self.stamps_ns[rows],
            load_scan=lambda k: self.load_scan(k + rows.start),
            reference=reference,
            gps=tuple(fix for fix in self.gps if fix.stamp_ns > before),
            forward_speed_m_s=None if self.forward_speed_m_s is None else self.forward_speed_m_s[rows],
        )

    def _frame(self, k: int, scan: Scan) -> Frame:
        end = int(self.stamps_ns[k])
        start = int(self.stamps_ns[k - 1]) if k else self._first_stamp_ns()
        first, last = (
            bisect_right(self.gps, t, key=lambda fix: fix.stamp_ns) for t in (start if k else start - 1, end)
        )
        return Frame(
            k,
            scan,
            imu=self.imu.between(start, end),
            gps=self.gps[first:last],
            sweep_imu=self._during(scan),
            calibration=self.calibration,
            imu_noise=self.imu_noise,
        )

    def _during(self, scan: Scan) -> ImuSamples:
        """The samples from the scan's first point to its last, where points carry times."""
        if scan.time_offsets_ns is None or not len(scan):
            return ImuSamples.empty()
        first, last = scan.time_offsets_ns.min(), scan.time_offsets_ns.max()
        return self.imu.between(scan.stamp_ns + int(first), scan.stamp_ns + int(last))

    def __iter__(self) -> Iterator[Frame]:
        return (self[k] for k in range(len(self)))

    def _first_stamp_ns(self) -> int:
        """The earliest stamp of any sensor, for what the first frame carries."""
        firsts = [int(self.stamps_ns[0])]
        firsts += [int(self.imu.stamps_ns[0])] if len(self.imu) else []
        firsts += [self.gps[0].stamp_ns] if self.gps else []
        return min(firsts)

    @property
    def duration_s(self) -> float:
        """Seconds from the first scan to the last."""
        return float(self.stamps_ns[-1] - self.stamps_ns[0]) / NS_PER_S

    @property
    def gaps(self) -> tuple[tuple[int, float], ...]:
        """Where scans are missing: ``(k, seconds since scan k-1)`` for each step over 1.5 times the median one."""
        steps = np.diff(self.stamps_ns) / NS_PER_S
        large = np.flatnonzero(steps > 1.5 * np.median(steps)) if len(steps) else np.empty(0, np.int64)
        return tuple((int(k) + 1, float(steps[k])) for k in large)


def frame_range(frames: str) -> tuple[int | None, int | None]:
    """The ends of a range ``A:B``; None for one that is left out.

    Raises:
        ConfigError: it is no range.
    """
    try:
        start, stop = (int(end) if end.strip() else None for end in frames.split(":"))
    except ValueError:
        raise ConfigError(f"frames {frames!r}: give a range such as 100:200, 100: or :200") from None
    return start, stop


def part_of(sequence: Sequence, frames: str | None) -> Sequence:
    """The frames ``A:B`` of a sequence, as Python counts them; all without a range.

    Raises:
        ConfigError: ``frames`` is no range.
        DataError: no frame is left.
    """
    return sequence if frames is None else sequence.part(*frame_range(frames))
