"""A recording as a sequence of frames, whose scans are loaded on demand; what every reader returns."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from hybridlio.core.arrays import Array, Stamps
from hybridlio.core.errors import ConfigError, DataError, HybridLioError, strip_control
from hybridlio.core.imu_scale import ImuScale
from hybridlio.core.lidar_models import LidarModel
from hybridlio.core.sensors import NS_PER_S, Calibration, Frame, GpsFix, ImuNoise, ImuSamples, Scan
from hybridlio.core.trajectory import Trajectory
from hybridlio.datasets.source import Source


@dataclass(frozen=True, eq=False)
class Sequence:
    """A recording: ``N`` scans and what other sensors measured meanwhile, all stamps on one clock.

    ``len()`` is the number of scans; indexing and iterating return :class:`~hybridlio.core.sensors.Frame` objects.

    Attributes:
        name: short name for tables and run folders.
        stamps_ns: ``(N,)`` int64, one per scan, strictly increasing.
        load_scan: returns scan ``k``; called each time a frame is requested. Must be picklable to run recordings in
            other processes.
        imu: all IMU samples; may be empty.
        calibration: the extrinsics.
        reference: ground-truth lidar poses in the first scan's frame, one per scan, or None.
        gps: fixes in order of time.
        lidar: the lidar's model, or None if unknown; sets the limits of vertex maps.
        pose_file_frame: ``lidar`` or ``camera``, the frame that KITTI pose files of this recording use.
        forward_speed_m_s: ``(N,)`` forward speed at the scans from the vehicle's navigation system, or None; a check
            of a trajectory's length if reference positions are poor.
        imu_noise: the IMU's noise densities, or None if the recording does not give them.
        imu_time_offset_s: seconds that were added to the IMU's stamps to bring them to the scans' clock: stated by the
            recording's calibration, or found (:func:`hybridlio.runs.recording_check.check_recording`); None if neither.
        imu_scale: the scale that the IMU's samples were corrected by, as the recording's calibration states it.
        notes: what the reader found unusual (gaps, dropped stamps, substitutes); also logged when opening.
        source: how to open the recording again; None for one that was made in memory.

    Raises:
        DataError: no scans, stamps that do not increase, ``reference`` or ``forward_speed_m_s`` of another length, or
            GPS fixes out of order.
    """

    name: str
    stamps_ns: Stamps
    load_scan: Callable[[int], Scan]
    imu: ImuSamples = field(default_factory=ImuSamples.empty)
    calibration: Calibration = field(default_factory=Calibration)
    reference: Trajectory | None = None
    gps: tuple[GpsFix, ...] = ()
    lidar: LidarModel | None = None
    pose_file_frame: str = "lidar"
    forward_speed_m_s: Array | None = None
    imu_noise: ImuNoise | None = None
    imu_time_offset_s: float | None = None
    imu_scale: ImuScale = field(default_factory=ImuScale)
    notes: tuple[str, ...] = ()
    source: Source | None = None

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
            raise DataError(f"{self.name}: GPS fixes are not in order of time; sort them by stamp")

    def __repr__(self) -> str:
        reference = "" if self.reference is None else ", with reference"
        return (
            f"Sequence({self.name!r}, {len(self)} scans in {self.duration_s:.1f} s, {len(self.imu)} IMU samples, "
            f"{len(self.gps)} GPS fixes{reference})"
        )

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def __getitem__(self, index: int) -> Frame:
        """Load frame ``index``; negative indices count from the end.

        Raises:
            IndexError: there is no such frame.
            ConfigError: the index is a slice, for which :meth:`part` and :meth:`every` are.
            DataError: the scan cannot be read. :meth:`without_scan` returns the frame without it.
        """
        if isinstance(index, slice):
            raise ConfigError(f"{self.name}: one frame at a time; part(start, stop) and every(step) return a sequence")
        k = range(len(self))[index]
        return self._frame(k, self._scan(k))

    def without_scan(self, index: int) -> Frame:
        """Return frame ``index`` with an empty scan, to continue after a scan that cannot be read."""
        k = range(len(self))[index]
        return self._frame(k, Scan(int(self.stamps_ns[k]), np.empty((0, 3), np.float32)))

    def part(self, start: int | None, stop: int | None) -> Sequence:
        """Return frames ``start`` to ``stop`` (exclusive) as a sequence; index 0 and the reference start at ``start``.

        All IMU samples are kept: those before the first scan help to estimate the vertical.

        Raises:
            DataError: the range is empty.
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
            source=None if self.source is None else self.source.part(rows.start, rows.stop),
        )

    def every(self, step: int) -> Sequence:
        """Return one frame in ``step``, from the first on; all samples and fixes are kept.

        Raises:
            ConfigError: the step is below 1.
        """
        if step < 1:
            raise ConfigError(f"{self.name}: one scan in {step} is none; take 1 or more")
        if step == 1:
            return self
        rows, reference = slice(None, None, step), self.reference
        return replace(
            self,
            stamps_ns=self.stamps_ns[rows],
            load_scan=lambda k: self.load_scan(k * step),
            reference=None if reference is None else Trajectory(reference.stamps_ns[rows], reference.poses[rows]),
            forward_speed_m_s=None if self.forward_speed_m_s is None else self.forward_speed_m_s[rows],
            source=None if self.source is None else self.source.every(step),
            notes=(*self.notes, f"one scan in {step} is used"),
        )

    def _scan(self, k: int) -> Scan:
        """Load scan ``k``. Whatever a library raises about a damaged file becomes a DataError, so a run bridges it."""
        try:
            return self.load_scan(k)
        except HybridLioError:
            raise
        except Exception as error:
            reason = " ".join(strip_control(f"{type(error).__name__}: {error}").split())
            raise DataError(f"frame {k}: the scan cannot be read ({reason})") from error

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
            sweep_imu=self.imu.during(scan),
            calibration=self.calibration,
            imu_noise=self.imu_noise,
        )

    def __iter__(self) -> Iterator[Frame]:
        return (self[k] for k in range(len(self)))

    def _first_stamp_ns(self) -> int:
        """Return the earliest stamp of any sensor, where the first frame's interval starts."""
        firsts = [int(self.stamps_ns[0])]
        firsts += [int(self.imu.stamps_ns[0])] if len(self.imu) else []
        firsts += [self.gps[0].stamp_ns] if self.gps else []
        return min(firsts)

    @property
    def duration_s(self) -> float:
        """Seconds from the first scan to the last."""
        return float(self.stamps_ns[-1] - self.stamps_ns[0]) / NS_PER_S


def frame_range(frames: str) -> tuple[int | None, int | None]:
    """Parse a range ``A:B``, ``A:`` or ``:B``; an omitted end is None.

    Raises:
        ConfigError: ``frames`` is not such a range, or is empty for every recording.
    """
    try:
        start, stop = (int(end) if end.strip() else None for end in frames.split(":"))
    except ValueError:
        raise ConfigError(f"frames {frames!r}: give a range such as 100:200, 100: or :200") from None
    if start is not None and stop is not None and (start < 0) == (stop < 0) and stop <= start:
        raise ConfigError(f"frames {frames!r}: the range is empty; its end must be after its start")
    return start, stop


def part_of(sequence: Sequence, frames: str | None) -> Sequence:
    """Return the frames ``A:B`` of a sequence, as a Python slice; the whole sequence for None.

    Raises:
        ConfigError: ``frames`` is not a range.
        DataError: the range is empty.
    """
    return sequence if frames is None else sequence.part(*frame_range(frames))
