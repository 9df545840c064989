"""Frames from measurements that arrive one by one, in any order across sensors."""

from __future__ import annotations

import logging
from bisect import bisect_left, bisect_right, insort

import numpy as np

from hybridlio.core.arrays import Floats
from hybridlio.core.errors import DataError
from hybridlio.core.sensors import NS_PER_S, Calibration, Frame, GpsFix, ImuNoise, Scan
from hybridlio.odometry.imu_buffer import ImuBuffer, Values
from hybridlio.odometry.stream_counts import StreamCounts

_log = logging.getLogger(__name__)

# Start-up levels with the samples of 1 s before the first scan, and a sweep starts at most 1 s before its stamp.
_NEEDED_NS = 2 * NS_PER_S
# Kept at most while no scan comes: bridging a longer gap by the IMU alone is off by hundreds of metres.
_KEPT_NS = 60 * NS_PER_S
# No network delays data so long, and a recording that is played again steps back further.
_CLOCK_STEP_NS = 10 * NS_PER_S
_LOGGED = 3  # warnings of each kind; the counts show the others


class FrameAssembler:
    """Collects measurements, and gives frames in order of time when their data are complete.

    Args:
        calibration: the extrinsics; None if there is no IMU.
        imu_noise: the IMU's noise densities, or None for the defaults.
        lag_ns: how long a scan waits for IMU samples, on the clock of the stamps.
        reorder_ns: by how much stamps of one sensor may step back.
    """

    def __init__(
        self, calibration: Calibration | None, imu_noise: ImuNoise | None, lag_ns: int, reorder_ns: int
    ) -> None:
        self.counts, self.imu = StreamCounts(), ImuBuffer()
        self._calibration, self._imu_noise = calibration, imu_noise
        self._lag_ns, self._reorder_ns = lag_ns, reorder_ns
        self._scans: list[Scan] = []
        self.fixes: list[GpsFix] = []  # those not in a frame yet, in order of time
        self._newest_ns: int | None = None  # of any sensor
        self._taken_ns: int | None = None  # stamp of the last scan given as a frame
        self._index = 0
        self._last_points: Floats | None = None

    def add_imu(self, stamp_ns: int, values: Values) -> None:
        """Add a sample, or count it as late or repeated."""
        self._check_clock(stamp_ns, "IMU sample")
        self.counts.imu += 1
        if self._taken_ns is not None and stamp_ns <= self._taken_ns:
            self.counts.late_imu += 1
            self._warn(self.counts.late_imu, stamp_ns, "IMU sample", "a larger lag_s or reorder_s makes scans wait")
            return
        if not self.imu.add(stamp_ns, values):
            self.counts.repeated_imu += 1
            return
        self._note(stamp_ns)
        self._forget()

    def add_scan(self, scan: Scan) -> None:
        """Add a scan, or count it as late."""
        self._check_clock(scan.stamp_ns, "scan")
        self.counts.scans += 1
        at = bisect_left(self._scans, scan.stamp_ns, key=lambda s: s.stamp_ns)
        repeated = at < len(self._scans) and self._scans[at].stamp_ns == scan.stamp_ns
        if repeated or (self._taken_ns is not None and scan.stamp_ns <= self._taken_ns):
            self.counts.late_scans += 1
            self._warn(self.counts.late_scans, scan.stamp_ns, "scan", "a larger reorder_s makes scans wait")
            return
        self._scans.insert(at, scan)
        self._note(scan.stamp_ns)

    def add_fix(self, fix: GpsFix) -> None:
        """Add a fix; one that is late goes into the next frame."""
        self._check_clock(fix.stamp_ns, "GPS fix")
        self.counts.fixes += 1
        self.counts.late_fixes += self._taken_ns is not None and fix.stamp_ns <= self._taken_ns
        insort(self.fixes, fix, key=lambda f: f.stamp_ns)
        del self.fixes[: bisect_left(self.fixes, fix.stamp_ns - _KEPT_NS, key=lambda f: f.stamp_ns)]

    def skip_scans(self, behind_ns: int) -> None:
        """Drop waiting scans that are more than ``behind_ns`` older than the newest data."""
        assert self._newest_ns is not None
        count = bisect_left(self._scans, self._newest_ns - behind_ns, key=lambda s: s.stamp_ns)
        if count:
            self.counts.skipped_scans += count
            if self.counts.skipped_scans - count < _LOGGED:
                _log.warning("estimation is too slow: %d scans skipped so far", self.counts.skipped_scans)
            del self._scans[:count]

    def has_frame(self, everything: bool) -> bool:
        """Return whether :meth:`next_frame` gives one."""
        return bool(self._scans) and (everything or self._is_ready(self._scans[0]))

    def next_frame(self, everything: bool = False) -> Frame | None:
        """Return the next frame if its data are complete or the lag is over, or in any case for ``everything``."""
        if not self.has_frame(everything):
            return None
        scan = self._scans.pop(0)
        if self._calibration is not None and not self._covers(scan):
            self.counts.without_imu += 1
            if self.counts.without_imu <= _LOGGED:
                _log.warning("scan at %d ns: IMU samples are missing: %s", scan.stamp_ns, self._missing(scan))
        scan = self._without_repeated_points(scan)
        before_ns = self._taken_ns
        around = self.imu.around(min(_start(scan), before_ns or _start(scan)) - _NEEDED_NS, _end(scan))
        if before_ns is None:
            before_ns = min([scan.stamp_ns, *around.stamps_ns[:1].tolist()])
        fixes = bisect_right(self.fixes, scan.stamp_ns, key=lambda f: f.stamp_ns)
        frame = Frame(
            self._index,
            scan,
            imu=around.between(before_ns, scan.stamp_ns),
            gps=tuple(self.fixes[:fixes]),
            sweep_imu=around.during(scan),
            calibration=self._calibration,
            imu_noise=self._imu_noise,
        )
        del self.fixes[:fixes]
        self._taken_ns, self._index = scan.stamp_ns, self._index + 1
        self._forget()
        return frame

    def waiting(self) -> int:
        """Return the number of scans that wait."""
        return len(self._scans)

    def _is_ready(self, scan: Scan) -> bool:
        assert self._newest_ns is not None
        end_ns = _end(scan) + self._reorder_ns
        if self._calibration is None:
            return self._newest_ns >= scan.stamp_ns + self._reorder_ns
        newest = self.imu.newest_ns
        return (newest is not None and newest >= end_ns) or self._newest_ns >= end_ns + self._lag_ns

    def _covers(self, scan: Scan) -> bool:
        """Return whether IMU samples reach over the scan; those before the first scan need not."""
        imu = self.imu.around(scan.stamp_ns, _end(scan))
        reached = len(imu) and imu.stamps_ns[-1] >= _end(scan)
        return bool(reached and (imu.stamps_ns[0] <= scan.stamp_ns or self._taken_ns is None))

    def _missing(self, scan: Scan) -> str:
        newest, end_ns = self.imu.newest_ns, _end(scan)
        if newest is None:
            return "no IMU sample has come yet"
        samples = self.imu.around(scan.stamp_ns, end_ns).stamps_ns
        after_s, before_s = (int(samples[0]) - scan.stamp_ns) / NS_PER_S, (end_ns - newest) / NS_PER_S
        text = f"they start {after_s:.3f} s after it" if before_s <= 0 else f"they end {before_s:.3f} s before it"
        return text + ("; do the clocks differ?" if max(after_s, before_s) > _KEPT_NS / NS_PER_S else "")

    def _without_repeated_points(self, scan: Scan) -> Scan:
        before, self._last_points = self._last_points, scan.points
        if before is None or not len(scan) or not np.array_equal(scan.points, before):
            return scan
        self.counts.repeated_points += 1
        return Scan(scan.stamp_ns, np.empty((0, 3), np.float32))

    def _check_clock(self, stamp_ns: int, what: str) -> None:
        if self._taken_ns is not None and stamp_ns < self._taken_ns - _CLOCK_STEP_NS:
            raise DataError(
                f"{what} at {stamp_ns} ns: {(self._taken_ns - stamp_ns) / NS_PER_S:.1f} s before the last estimate; "
                "has the clock stepped back? Make a new stream"
            )

    def _note(self, stamp_ns: int) -> None:
        self._newest_ns = stamp_ns if self._newest_ns is None else max(self._newest_ns, stamp_ns)

    def _forget(self) -> None:
        oldest = (self.imu.newest_ns or 0) - _KEPT_NS
        self.imu.forget_before(oldest if self._taken_ns is None else max(oldest, self._taken_ns - _NEEDED_NS))

    def _warn(self, count: int, stamp_ns: int, what: str, remedy: str) -> None:
        if count <= _LOGGED:
            _log.warning("%s at %d ns: late or repeated, not used; %s", what, stamp_ns, remedy)


def _end(scan: Scan) -> int:
    """Return the time up to which IMU samples are needed."""
    offsets = scan.time_offsets_ns
    return scan.stamp_ns + (max(0, int(offsets.max())) if offsets is not None and len(offsets) else 0)


def _start(scan: Scan) -> int:
    offsets = scan.time_offsets_ns
    return scan.stamp_ns + (min(0, int(offsets.min())) if offsets is not None and len(offsets) else 0)
