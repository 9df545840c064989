"""The check of a recording before a run: whether its IMU and its scans measure one motion.

A quick registration of scans alone, over the stretches in which the IMU turns most, gives a path, and the IMU is
compared with it (:mod:`hybridlio.calibration.imu_check`). The offset of the clocks is found and applied, units are
corrected, and gross errors of the mounting end a run before it begins.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from hybridlio.calibration.clock_offset import LEAST_OFFSET_S
from hybridlio.calibration.imu_check import ImuCheck, check_imu
from hybridlio.core.errors import DataError
from hybridlio.core.progress import Progress
from hybridlio.core.sensors import NS_PER_S, ImuSamples, Scan
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.sequence import Sequence
from hybridlio.sources.scan_path import ScanPath, best_paths, scan_paths

LARGEST_OFFSET_S = 0.2  # drivers that stamp on arrival are late by less; larger offsets are of clocks never set
# Four stretches of ten seconds at 10 Hz: the offset is then known to 0.5 ms in ordinary driving, as the gyroscope's
# noise allows. Two are enough to see that the clocks agree (benchmarks/clock_offsets.py has accuracy and time).
_STRETCHES, _FIRST_STRETCHES, _STRETCH_SCANS = 4, 2, 100
_QUIET_SCANS = 15  # of a stretch, among which it begins at the one that turns least
_LEAST_SCANS = 60  # in a recording, for 50 steps that the samples cover
_POINTS = 30_000
_MAX_PASSES = 6  # of scans that need motion compensation, which depends on the offset: the error falls to a tenth a
# pass in a car, to a quarter in a hand that turns fast
_SETTLED_S = 5e-4
_COARSE_S = 0.02  # standard deviation of an offset that compensation begins with: as fine as the search and its step
_LARGEST_RATE_RAD_S = 6.0  # of 95 % of samples; rates beyond are of another unit and no help to compensate scans


def check_recording(sequence: Sequence, progress: Progress | None = None) -> Sequence:
    """Return a sequence whose IMU has been compared with its scans: stamps and units corrected, and notes added.

    It is returned as it is if ``imu_time_offset_s`` of its calibration states the clocks' offset, without IMU samples,
    and if fewer than 60 scans can be used.

    Args:
        sequence: the recording, or a part of it.
        progress: called with the scans done.

    Raises:
        DataError: the IMU or its mounting is wrong; the message says what and what to do.
    """
    check = compare_imu(sequence, progress) if is_comparable(sequence) else None
    if check is None:
        return sequence
    if check.wrong:
        raise DataError(f"{sequence.name}: {check.wrong[0]}. To run all the same: --no-check")
    notes = Notes(sequence.name, list(sequence.notes))
    for text in check.corrected:
        notes.corrected(text)
    for text in check.doubtful:
        notes.add(text)
    is_moved = check.offset is not None and check.offset.is_significant
    applied_s = check.offset.offset_s if check.offset is not None and is_moved else None
    return replace(sequence, imu=check.imu, notes=tuple(notes.texts), imu_time_offset_s=applied_s)


def is_comparable(sequence: Sequence) -> bool:
    """Whether a recording has samples and scans enough to compare, and does not state the offset of its clocks."""
    return sequence.imu_time_offset_s is None and len(sequence.imu) > 1 and len(sequence) >= _LEAST_SCANS


def compare_imu(sequence: Sequence, progress: Progress | None = None) -> ImuCheck | None:
    """Return what the comparison of IMU and scans shows; None if too few scans can be used."""
    recording = _Loaded(sequence, progress)
    rates = np.linalg.norm(sequence.imu.gyro_rad_s, axis=1)
    compensating = sequence.imu if np.quantile(rates, 0.95) < _LARGEST_RATE_RAD_S else ImuSamples.empty()
    paths: list[ScanPath] = []
    check, before_s = None, 0.0
    for _ in range(_MAX_PASSES):
        paths = recording.paths(slice(None, _FIRST_STRETCHES), compensating)
        check = recording.check(paths)
        if check is None or check.wrong or not recording.are_distorted:
            break
        now_s = check.offset.offset_s if _is_known_coarsely(check) and check.offset is not None else 0.0
        if abs(now_s - before_s) < _SETTLED_S and len(compensating):
            break
        before_s, compensating = now_s, _moved(check)
    if check is not None and (check.wrong or _is_on_time(check)):
        return check
    return recording.check(paths + recording.paths(slice(_FIRST_STRETCHES, None), compensating))


class _Loaded:
    """The scans of a recording's stretches, thinned, in memory."""

    def __init__(self, sequence: Sequence, progress: Progress | None) -> None:
        self._sequence, self._progress = sequence, progress
        self._stretches = [_loaded(sequence, rows) for rows in _stretches(sequence)]
        self._done, self._total = 0, sum(map(len, self._stretches))

    @property
    def are_distorted(self) -> bool:
        """Whether motion compensation, and so the offset of the clocks, changes the scans."""
        return any(scan.time_offsets_ns is not None for stretch in self._stretches for scan in stretch)

    def paths(self, stretches: slice, compensating: ImuSamples) -> list[ScanPath]:
        """Return the lidar's paths through some stretches, compensated by the gyroscope if it has samples."""
        calibration = self._sequence.calibration
        return [
            path
            for stretch in self._stretches[stretches]
            for path in scan_paths(self._counted(stretch), calibration, compensating)
        ]

    def check(self, paths: list[ScanPath]) -> ImuCheck | None:
        """Return the comparison of the samples with paths."""
        right = best_paths(paths)
        if sum(map(len, right)) < _LEAST_SCANS:
            return None
        return check_imu(right, self._sequence.imu, self._sequence.calibration.T_imu_lidar, LARGEST_OFFSET_S)

    def _counted(self, scans: list[Scan]) -> Iterator[Scan]:
        for scan in scans:
            self._done = min(self._done + 1, self._total)
            if self._progress is not None:
                self._progress("", self._done, self._total)
            yield scan


def _is_on_time(check: ImuCheck) -> bool:
    """Whether the offset is known to be too small to matter, so that more scans would change nothing."""
    offset = check.offset
    return offset is not None and offset.is_determined and abs(offset.offset_s) + 2 * offset.sigma_s < LEAST_OFFSET_S


def _is_known_coarsely(check: ImuCheck) -> bool:
    """Whether motion compensation is better with the offset that was found than without."""
    offset = check.offset
    return offset is not None and not offset.contradicts and offset.sigma_s < _COARSE_S


def _moved(check: ImuCheck) -> ImuSamples:
    """Return the samples at the offset that was found, significant or not, without the gyroscope's bias."""
    imu, offset = check.imu, check.offset
    if offset is None:
        return imu
    to_come_ns = 0 if offset.is_significant or not _is_known_coarsely(check) else round(offset.offset_s * NS_PER_S)
    return ImuSamples(imu.stamps_ns + to_come_ns, imu.gyro_rad_s - offset.gyro_bias_rad_s, imu.accel_m_s2)


def _stretches(sequence: Sequence) -> list[range]:
    """Return the stretches of scans over which the IMU's rates vary most, the one in which they vary most first."""
    scans = len(sequence)
    tiles = [range(start, min(start + _STRETCH_SCANS, scans)) for start in range(0, scans, _STRETCH_SCANS)]
    chosen = sorted(tiles, key=lambda rows: -_energy(sequence, rows))[:_STRETCHES]
    return [range(_quiet_start(sequence, rows), rows.stop) for rows in chosen]


def _quiet_start(sequence: Sequence, rows: range) -> int:
    """Return the scan near the start of a stretch at which the IMU turns least: the first step is found most easily."""
    imu, first = sequence.imu, rows[:_QUIET_SCANS]
    nearest = np.clip(np.searchsorted(imu.stamps_ns, sequence.stamps_ns[first.start : first.stop]), 0, len(imu) - 1)
    return first[int(np.linalg.norm(imu.gyro_rad_s[nearest], axis=1).argmin())]


def _energy(sequence: Sequence, rows: range) -> float:
    """Return the sum of squares of the IMU's rates about their mean; 0 without samples."""
    samples = slice(*np.searchsorted(sequence.imu.stamps_ns, sequence.stamps_ns[[rows[0], rows[-1]]]))
    rates = sequence.imu.gyro_rad_s[samples]
    return float(((rates - rates.mean(axis=0)) ** 2).sum()) if len(rates) else 0.0


def _loaded(sequence: Sequence, rows: range) -> list[Scan]:
    """Return the scans of a stretch that can be read, thinned."""
    scans = []
    for k in rows:
        try:
            scans.append(_thinned(sequence[k].scan))
        except DataError:
            continue  # the run reports it
    return scans


def _thinned(scan: Scan) -> Scan:
    every = max(1, len(scan) // _POINTS) | 1  # an odd step: a stored order by 2^n beams then loses no beam
    times = scan.time_offsets_ns
    return Scan(scan.stamp_ns, scan.points[::every], None, None if times is None else times[::every])
