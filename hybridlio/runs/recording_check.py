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
from hybridlio.calibration.compensation import LARGEST_OFFSET_S, LARGEST_SHARE, Compensation
from hybridlio.calibration.imu_check import ImuCheck, check_imu, moved
from hybridlio.core.errors import DataError
from hybridlio.core.progress import Progress
from hybridlio.core.sensors import ImuSamples, Scan
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.sequence import Sequence
from hybridlio.sources.scan_path import ScanPath, best_paths, scan_paths

# Four stretches of ten seconds at 10 Hz: the offset is then known to 0.5 ms in ordinary driving, as the gyroscope's
# noise allows. One is enough to see that the clocks agree (benchmarks/clock_offsets.py has accuracy and time).
_STRETCHES, _STRETCH_SCANS = 4, 100
_QUIET_SCANS = 15  # of a stretch, among which it begins at the one that turns least
_LEAST_SCANS = 60  # in a recording, for 50 steps that the samples cover
_POINTS = 30_000
_MAX_PASSES = 8  # with other stretches, or another compensation: three of the latter are usual in a car, five in a hand
# Where scans compensated with a wrong offset do not fit each other, the nearest of these is near enough to begin with.
_TRIED_SHIFTS_S, _TRIED_SCANS = (0.0, -0.05, 0.05, -0.1, 0.1, -0.15, 0.15), 40
_PRECISE_S = 3e-4  # standard deviation with which 1 ms is exceeded once in 1,000 recordings


def check_recording(sequence: Sequence, progress: Progress | None = None) -> Sequence:
    """Return a sequence whose IMU has been compared with its scans: stamps and units corrected, and notes added.

    It is returned as it is if ``imu_time_offset_s`` of its calibration states the clocks' offset, and without IMU
    samples. Where fewer than 60 scans can be used, or they do not determine the offset, a note says so.

    Args:
        sequence: the recording, or a part of it.
        progress: called with the scans done.

    Raises:
        DataError: the IMU or its mounting is wrong; the message says what and what to do.
    """
    if not is_checked(sequence):
        return sequence
    check = examine(sequence, progress)
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


def is_checked(sequence: Sequence) -> bool:
    """Whether a recording has samples to check, and does not state the offset of its clocks."""
    return sequence.imu_time_offset_s is None and len(sequence.imu) > 1


def examine(sequence: Sequence, progress: Progress | None = None) -> ImuCheck:
    """Return what the comparison of a recording's IMU and scans shows; where it shows no offset, the doubts say why."""
    found = compare_imu(sequence, progress) if is_comparable(sequence) else None
    found = found or ImuCheck(sequence.imu)
    if not found.wrong and (reason := _why_not_found(found)) is not None:
        found.doubtful.append(
            f"the offset of the IMU's clock was not found: {reason}. Stamps are taken as they are; if the clocks may "
            "differ, state imu_time_offset_s in calibration.yaml"
        )
    return found


def _why_not_found(check: ImuCheck) -> str | None:
    """Return why the offset of the clocks is not known; None where it is, or where the check says more of it."""
    offset = check.offset
    if offset is None:
        return f"too few scans could be compared; {_LEAST_SCANS + _QUIET_SCANS} in a row are enough"
    if offset.is_determined or offset.is_significant or offset.contradicts:
        return None
    if offset.sigma_s < LEAST_OFFSET_S:
        return "the gyroscope and the scans do not turn alike"
    return f"the motion shows it only to {1e3 * offset.sigma_s:.0f} ms"


def is_comparable(sequence: Sequence) -> bool:
    """Whether a recording is checked, and has scans enough to compare its samples with."""
    return is_checked(sequence) and len(sequence) >= _LEAST_SCANS


def compare_imu(sequence: Sequence, progress: Progress | None = None) -> ImuCheck | None:
    """Return what the comparison of IMU and scans shows; None if too few scans can be used.

    The stretch with most turns comes first, until the offset that compensates its scans is the one that is found. The
    others follow one by one while they could change the answer.
    """
    recording, compensation = _Loaded(sequence, progress), Compensation(sequence.imu)
    stretches, check = 1, None
    for _ in range(_MAX_PASSES):
        check = recording.check(recording.paths(stretches, compensation.imu))
        if recording.are_distorted and compensation.is_far_off(check):
            compensation.shift(recording.likely_shift_s(compensation.imu))
            continue
        if check is not None and _is_final(check, compensation, recording.are_distorted):
            break
        if recording.are_distorted and check is not None and compensation.improve(check):
            continue
        if (check is not None and check.wrong and stretches > 1) or stretches == recording.stretches:
            break
        stretches += 1
    if check is None or check.offset is None or not recording.are_distorted:
        return check
    return recording.check(recording.paths(stretches, compensation.imu), compensation.more_sigma_s(check.offset))


class _Loaded:
    """The scans of a recording's stretches, thinned, in memory."""

    def __init__(self, sequence: Sequence, progress: Progress | None) -> None:
        self._sequence, self._progress = sequence, progress
        self._rows = _stretches(sequence)
        self._stretches: dict[int, list[Scan]] = {}
        self._paths: dict[int, list[ScanPath]] = {}
        self._compensating: ImuSamples | None = None
        self._done, self._total = 0, sum(map(len, self._rows))

    @property
    def stretches(self) -> int:
        """Number of stretches."""
        return len(self._rows)

    @property
    def are_distorted(self) -> bool:
        """Whether motion compensation, and so the offset of the clocks, changes the scans loaded so far."""
        return any(scan.time_offsets_ns is not None for stretch in self._stretches.values() for scan in stretch)

    def paths(self, stretches: int, compensating: ImuSamples) -> list[ScanPath]:
        """Return the lidar's paths through the first stretches, compensated by the gyroscope if it has samples."""
        if compensating is not self._compensating:
            self._compensating, self._paths = compensating, {}
        for stretch in range(stretches):
            if stretch not in self._stretches:
                self._stretches[stretch] = _loaded(self._sequence, self._rows[stretch])
            if stretch not in self._paths:
                scans = self._counted(self._stretches[stretch])
                self._paths[stretch] = scan_paths(scans, self._sequence.calibration, compensating)
        return [path for stretch in range(stretches) for path in self._paths[stretch]]

    def likely_shift_s(self, compensating: ImuSamples) -> float:
        """Return the shift of the samples with which scans fit each other longest, and best."""

        def quality(shift_s: float) -> tuple[int, float]:
            scans, samples = self._stretches[0][:_TRIED_SCANS], moved(compensating, shift_s)
            paths = scan_paths(scans, self._sequence.calibration, samples)
            return max(((len(path.trajectory), -path.sigma_m) for path in paths), default=(0, 0.0))

        return max(_TRIED_SHIFTS_S, key=quality)

    def check(self, paths: list[ScanPath], more_sigma_s: float = 0.0) -> ImuCheck | None:
        """Return the comparison of the samples with paths; the offset's deviation is larger by ``more_sigma_s``."""
        right = best_paths(paths)
        trajectories = [path.trajectory for path in right]
        if sum(map(len, trajectories)) < _LEAST_SCANS:
            return None
        measured = np.concatenate([path.measured for path in right])
        imu, T_imu_lidar = self._sequence.imu, self._sequence.calibration.T_imu_lidar
        return check_imu(trajectories, imu, T_imu_lidar, LARGEST_OFFSET_S, measured, more_sigma_s)

    def _counted(self, scans: list[Scan]) -> Iterator[Scan]:
        for scan in scans:
            self._done = min(self._done + 1, self._total)
            if self._progress is not None:
                self._progress("", self._done, self._total)
            yield scan


def _is_final(check: ImuCheck, compensation: Compensation, are_distorted: bool) -> bool:
    """Whether more scans, or others to compensate them with, would not change the answer in a way that matters."""
    if not are_distorted:
        return _is_on_time(check) or _is_precise(check)
    if compensation.is_new:
        return _is_on_time(check, LARGEST_SHARE)
    agrees = check.offset is not None and compensation.agrees(check.offset)
    return agrees and (_is_on_time(check) or _is_precise(check))


def _is_on_time(check: ImuCheck, share: float = 0.0) -> bool:
    """Whether the offset is known to be too small to matter, so that more scans would change nothing.

    Args:
        check: of the scans so far.
        share: of the offset that their compensation, with the stamps as they are, may have hidden.
    """
    offset = check.offset
    if offset is None or check.wrong or not offset.is_determined:
        return False
    return abs(offset.offset_s) / (1 - share) + 2 * offset.sigma_s < LEAST_OFFSET_S


def _is_precise(check: ImuCheck) -> bool:
    """Whether more scans would not make the offset better in a way that matters, and nothing else is in doubt."""
    offset = check.offset
    is_clear = not check.wrong and not check.doubtful
    return is_clear and offset is not None and offset.is_significant and offset.sigma_s < _PRECISE_S


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
