"""The journal of a run that is not finished: what is in it, and how the run goes on from there.

:mod:`hybridlio.runs.unfinished.keeper` writes it.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from hybridlio.core.errors import ConfigError, DataError, HybridLioError
from hybridlio.core.estimates import State
from hybridlio.core.sensors import Frame, GpsFix, ImuNoise, ImuSamples, Scan
from hybridlio.datasets.sequence import Sequence
from hybridlio.odometry.config import Config
from hybridlio.odometry.estimate import Estimate, steps_of, trajectory_of
from hybridlio.record import journal
from hybridlio.record.loop_keyframes import PackedKeyframe, unpacked
from hybridlio.record.plain_values import check_names, decode
from hybridlio.record.record import Record
from hybridlio.record.recorder import Recorder
from hybridlio.runs.folder import StoredRun
from hybridlio.runs.run import FrameByFrame, Run
from hybridlio.runs.unfinished.identity import HEADER_NAMES, header_of, points_digest
from hybridlio.runs.whole_folder import JOURNAL, STATE, partial_folder

_log = logging.getLogger(__name__)

# A processor with other instructions rounds differently; over an hour that may grow to nanometres. A micrometre is far
# below any standard deviation, and with wrong data the first steps differ by more.
_MAX_DIFFERENCE = 1e-6
_MALFORMED = (ValueError, TypeError, KeyError, IndexError, AttributeError, ImportError, HybridLioError)
_ROW_LISTS = ("estimates", "inputs", "reading_s", "keyframes")  # that each block continues
_LATEST = ("start", "imu_noise", "unreadable", "skipped", "seconds")  # that each block replaces

Inputs = tuple[ImuSamples, tuple[GpsFix, ...]]  # of one frame


@dataclass(eq=False)
class Kept:
    """A run as it stands in a journal.

    Attributes:
        header: what the run was started with, see :func:`header_of`.
        length: of the journal up to its last whole block, in bytes.
        estimates: one per scan, from the first usable scan on.
        inputs: IMU samples and fixes of each.
        reading_s: seconds spent reading, one per estimate.
        keyframes: the loop keyframes, packed.
        start: prior state at the first scan; None before the second estimate.
        imu_noise: the IMU's noise densities that the run assumes; None likewise.
        unreadable: see :attr:`hybridlio.runs.run.Run.unreadable`.
        skipped: number of scans before the first usable one.
        seconds: wall time so far.
    """

    header: dict[str, Any]
    length: int
    estimates: list[Estimate] = field(default_factory=list)
    inputs: list[Inputs] = field(default_factory=list)
    reading_s: list[float] = field(default_factory=list)
    keyframes: list[PackedKeyframe] = field(default_factory=list)
    start: State | None = None
    imu_noise: ImuNoise | None = None
    unreadable: dict[int, str] = field(default_factory=dict)
    skipped: int = 0
    seconds: float = 0.0

    def record(self) -> Record:
        """Return what smoothing needs of the run so far.

        Raises:
            DataError: there are fewer than two estimates.
        """
        if self.start is None or self.imu_noise is None or len(self.estimates) < 2:
            raise DataError("the run was killed before its second estimate; there is nothing to smooth")
        recorder = Recorder()
        for estimate, (imu, gps) in zip(self.estimates, self.inputs, strict=True):
            step = None
            if estimate.initial is not None and estimate.relative is not None:
                step = estimate.initial, estimate.relative
            recorder.add(estimate.stamp_ns, estimate.pose, estimate.covariance, step, imu, gps)
        return recorder.record(self.start, self.header["calibration"], self.imu_noise, unpacked(self.keyframes))

    def stored(self, path: Path) -> StoredRun:
        """Return the run so far as if it had been interrupted and read from a folder ``path``."""
        header = self.header
        metrics: dict[str, Any] = {name: header[name] for name in ("pose_file_frame", "notes")}
        metrics |= {"hybridlio": header["version"], "sequence": header["name"], "frames": len(header["stamps_ns"])}
        metrics |= {"frames_done": self.skipped + len(self.estimates), "interrupted": True}
        metrics["notes"] += [f"killed after {metrics['frames_done']} of {metrics['frames']} scans"]
        T = header["calibration"].T_camera_lidar
        if T is not None and header["pose_file_frame"] == "camera":
            metrics["T_camera_lidar"] = T.tolist()
        before = header["stamps_ns"][: self.skipped]
        return StoredRun(
            path, trajectory_of(self.estimates), before, steps_of(self.estimates), header["reference"], metrics
        )

    def frames(self) -> Iterator[tuple[Frame, Estimate]]:
        """Yield the frame of each estimate, without points, and the estimate."""
        calibration, noise = self.header["calibration"], self.header["imu_noise"]
        for estimate, (imu, gps) in zip(self.estimates, self.inputs, strict=True):
            scan = Scan(estimate.stamp_ns, np.empty((0, 3), np.float32))
            yield Frame(estimate.index, scan, imu, gps, calibration=calibration, imu_noise=noise), estimate


def read_kept(folder: Path, rows: int | None = None) -> Kept | None:
    """Return the run in a journal; None if it has no estimate.

    Args:
        folder: the folder of the journal.
        rows: number of estimates whose blocks are read, from the first on.

    Raises:
        DataError: the journal is damaged.
    """
    kept: Kept | None = None
    try:
        for end, content in journal.blocks(folder / JOURNAL):
            block = decode(content)
            if kept is None:
                check_names(block, HEADER_NAMES, "header")
                kept = Kept(block, end)
                continue
            if rows is not None and len(kept.estimates) >= rows:
                break
            check_names(block, (*_ROW_LISTS, *_LATEST), "block")
            for name in _ROW_LISTS:
                getattr(kept, name).extend(block[name])
            for name in _LATEST:
                setattr(kept, name, block[name])
            kept.length = end
    except _MALFORMED as error:
        raise _of_another_version(folder / JOURNAL, error) from error
    return kept if kept is not None and kept.estimates else None


def read_unfinished(path: Path) -> tuple[StoredRun, Record]:
    """Return the run that was killed before the folder ``path`` was written, or that writes it now, and its record.

    Raises:
        DataError: there is none, or its journal is damaged.
    """
    kept = read_kept(partial_folder(path))
    if kept is None:
        raise DataError(f"{path}: the run was killed before its first estimate was on the disk; run it again")
    return kept.stored(path), kept.record()


def resume_run(folder: Path, sequence: Sequence, config: Config, odometry: FrameByFrame) -> tuple[Run, int]:
    """Return a run as far as its journal and state go, and bring a new odometry there.

    Estimates after the state are made again, so that nothing but the time is lost.

    Returns:
        The run, and the length of the part of the journal that holds it; 0 for a run that starts again.

    Args:
        folder: the folder of the journal.
        sequence, config: recording and settings, the same as before.
        odometry: a new one with these settings.

    Raises:
        ConfigError: the journal is of another recording, other settings or another version; says which.
        DataError: the files are damaged.
    """
    run = Run(sequence, odometry)
    state = _read_state(folder)
    rows = None if state is None else state.pop("rows")
    kept = read_kept(folder, rows)
    if kept is None or state is None or len(kept.estimates) != rows:
        if kept is not None:
            _check_same(kept.header, header_of(sequence, config), folder)
        return run, 0  # killed within the first second
    _check_same(kept.header, header_of(sequence, config), folder)
    start_s = time.perf_counter()
    points = state.pop("points")
    try:
        difference = odometry.resume(kept.frames(), {**state, "keyframes": kept.keyframes})
    except DataError as error:
        raise _of_another_version(folder / STATE, error) from error
    run.last_points = _last_points(sequence, kept.estimates[-1].index)
    if difference > _MAX_DIFFERENCE or points_digest(run.last_points) != points:
        raise ConfigError(f"{folder}: the unfinished run is of other scans than {sequence.name}; give --overwrite")
    for estimate in kept.estimates:
        run.estimates.append(estimate)
    run.skipped, run.unreadable, run.reading_s = kept.skipped, kept.unreadable, kept.reading_s
    run.seconds = kept.seconds
    _log.info(
        "resumed after %d scans in %.1f s; poses differ by %.1g m", run.done, time.perf_counter() - start_s, difference
    )
    return run, kept.length


def resume_if_same(
    folder: Path, sequence: Sequence, config: Config, make_odometry: Callable[[], FrameByFrame]
) -> tuple[Run, int]:
    """Return what :func:`resume_run` does; a new run where there is no journal, or that of another run."""
    if (folder / JOURNAL).is_file():
        try:
            return resume_run(folder, sequence, config, make_odometry())
        except HybridLioError as error:
            _log.warning("started again, not resumed: %s", error)
    return Run(sequence, make_odometry()), 0


def _last_points(sequence: Sequence, index: int) -> Any:
    """Return the points of a scan, or of the last readable one before it."""
    for k in range(index, -1, -1):
        try:
            return sequence[k].scan.points
        except DataError:
            continue
    return None


def _read_state(folder: Path) -> dict[str, Any] | None:
    path = folder / STATE
    if not path.is_file():
        return None
    try:
        for _, content in journal.blocks(path):
            state = dict(decode(content))
            check_names(state.keys() & {"rows", "points"}, ("rows", "points"), "state")
            return state
    except _MALFORMED as error:
        raise _of_another_version(path, error) from error
    return None


def _of_another_version(path: Path, error: Exception) -> DataError:
    """Return the error for a file whose checksums are right and whose values are not those of this version."""
    smooth = "" if path.name == JOURNAL else "smooth what it has estimated, "
    return DataError(
        f"{path}: written by another version of hybridlio, or damaged ({error}); resume it with that version, "
        f"{smooth}or give --overwrite to start again"
    )


def _check_same(before: dict[str, Any], now: dict[str, Any], folder: Path) -> None:
    settings, own = _flat(before["settings"]), _flat(now["settings"])
    remedy = "use the same options, or give --overwrite"
    if before["version"] != now["version"]:
        what = f"by hybridlio {before['version']}, not {now['version']}"
    elif names := sorted(settings.keys() ^ own.keys()):
        what = f"by another version of hybridlio, with other settings ({', '.join(names)})"
        remedy = "resume it with that version, or give --overwrite"
    elif settings != own:
        what = f"with other settings ({', '.join(name for name in own if settings[name] != own[name])})"
    elif (before["name"], before["digest"]) != (now["name"], now["digest"]):
        what = f"of another recording, or of other frames of it ({before['name']})"
    else:
        return
    raise ConfigError(f"{folder}: the unfinished run is {what}; {remedy}")


def _flat(settings: dict[str, Any], group: str = "") -> dict[str, Any]:
    """Return settings by their dotted names."""
    found: dict[str, Any] = {}
    for name, value in settings.items():
        found |= _flat(value, f"{group}{name}.") if isinstance(value, dict) else {group + name: value}
    return found
