"""The scene of a finished run, from its folder or from memory, with or without its recording."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hybridlio.cloud.deskew import deskew
from hybridlio.core import se3
from hybridlio.core.arrays import Array, Floats
from hybridlio.core.errors import ConfigError, DataError
from hybridlio.core.files import user_path
from hybridlio.core.pose_interpolation import PosePath
from hybridlio.core.trajectory import Trajectory
from hybridlio.datasets.sequence import Sequence
from hybridlio.mapping.sweep_path import sweep_path
from hybridlio.odometry.estimate import InertialState
from hybridlio.record.loop_keyframes import LoopKeyframes
from hybridlio.record.record import Record
from hybridlio.runs.folder import KEYFRAMES, RECORD, STATES, StoredRun, read_run
from hybridlio.runs.results.map_source import open_map_source
from hybridlio.runs.results.states import States
from hybridlio.runs.run import Run
from hybridlio.viewing.placed_fixes import place_fixes, placed_by
from hybridlio.viewing.scene import Scene, ViewedScan, support_of, thinned

REFERENCE, ODOMETRY = "reference", "odometry"
_VERDICTS = {  # of the innovation gate, by the lists of frames in metrics.json
    "rejected": "rejected",
    "relocated": "relocated",
    "undecided": "undecided",
    "down_weighted": "down-weighted",
    "imu_left_out": "IMU left out",
}


class SweptScans:
    """The points of a recording's scans, thinned and motion compensated by a trajectory."""

    def __init__(self, sequence: Sequence, trajectory: Trajectory) -> None:
        self._sequence = sequence
        self._path = PosePath(trajectory.stamps_ns, trajectory.poses)

    def points(self, index: int) -> Floats | None:
        """Return points ``(N, 3)`` of a frame, lidar frame; None if it cannot be read."""
        try:
            scan = thinned(self._sequence[index].scan)
        except DataError:
            return None  # the run has bridged it, and says so
        if scan.time_offsets_ns is not None and len(scan):
            motion = sweep_path(self._path, scan, self._sequence.imu, self._sequence.calibration)
            scan = deskew(scan, motion)
        return scan.points


def scene_of(run: str | Path | Run, data: str | Path | None = None, with_scans: bool = True) -> Scene:
    """Return what there is to see of a finished run.

    Args:
        run: a run folder, smoothed or not, or a run in memory.
        data: the recording, if it is not where the run found it.
        with_scans: show the points of every scan, for which the recording is read. The map needs no recording.

    Raises:
        DataError: the run, or the recording given, cannot be read.
        ConfigError: ``run`` is neither a folder nor a run.
    """
    if isinstance(run, Run):
        return _of_memory(run, with_scans)
    if not isinstance(run, str | Path):
        raise ConfigError(f"expected a run folder or a Run, got {type(run).__name__}")
    folder = user_path(run)
    stored = read_run(folder)
    online = folder if (folder / RECORD).is_file() else folder.parent
    if not (online / RECORD).is_file():
        raise DataError(f"{folder}: there is no {RECORD} in it or above it; give a run folder that has not been moved")
    is_smoothed = online != folder
    record, first = Record.load(online / RECORD), len(stored.stamps_before)
    before = read_run(online) if is_smoothed else stored
    states = States.load(folder / STATES) if (folder / STATES).is_file() else None
    scans = _viewed(stored.trajectory, record, states, first, before.metrics)
    live, why_not = _live(folder, data, stored) if with_scans else (None, ())
    keyframes = LoopKeyframes.load(online / KEYFRAMES) if (online / KEYFRAMES).is_file() else None
    paths = _paths(stored) | ({ODOMETRY: before.trajectory} if is_smoothed else {})
    loops = stored.metrics.get("loops", {}).get("scans", ())
    without = (
        () if states is not None else ("left out: velocity and biases, which runs of earlier releases do not keep",)
    )
    return Scene(
        stored.metrics["sequence"],
        scans,
        _clouds(keyframes),
        live,
        _fixes(record, stored),
        tuple((int(a) - first, int(b) - first) for a, b in loops),
        paths,
        tuple(map(str, stored.metrics["notes"])),
        (*without, *why_not),
    )


def _of_memory(run: Run, with_scans: bool) -> Scene:
    record = run.record
    if record is None:
        raise DataError(f"{run.sequence.name}: the run has fewer than two estimates")
    scans, before = [], None
    for estimate in run.estimates:
        scans.append(ViewedScan.of_estimate(estimate, before))
        before = estimate.pose
    live = SweptScans(run.sequence, run.trajectory) if with_scans else None
    reference = run.sequence.reference
    paths = {} if reference is None else {REFERENCE: reference_from(reference, run.skipped, run.done)}
    fixes = place_fixes(record, run.trajectory)
    return Scene(run.sequence.name, tuple(scans), _clouds(record.keyframes), live, fixes, (), paths, run.sequence.notes)


def _viewed(
    trajectory: Trajectory, record: Record, states: States | None, first: int, metrics: Mapping[str, Any]
) -> tuple[ViewedScan, ...]:
    """Return the scans of a stored run, which ``metrics`` says more of."""
    verdicts = {int(k): verdict for name, verdict in _VERDICTS.items() for k in metrics.get(name, ())}
    covariances = trajectory.covariances
    assert covariances is not None  # read_run gives them
    out = []
    for row, stamp in enumerate(trajectory.stamps_ns.tolist()):
        scan = ViewedScan(first + row, stamp, trajectory.poses[row], covariances[row])
        if row:
            scan = _with_step(scan, trajectory.poses[row - 1], record, row - 1, verdicts.get(first + row, "accepted"))
        out.append(scan if states is None else _with_state(scan, states, row))
    return tuple(out)


def _with_step(scan: ViewedScan, before: Array, record: Record, step: int, verdict: str) -> ViewedScan:
    initial, relative = record.initial[step], record.relative[step]
    return ViewedScan(
        scan.index,
        scan.stamp_ns,
        scan.pose,
        scan.covariance,
        before @ initial.pose,
        se3.log(relative.pose @ se3.inverse(initial.pose)),
        relative.degenerate,
        support_of(verdict, relative.ok),
    )


def _with_state(scan: ViewedScan, states: States, row: int) -> ViewedScan:
    if row >= len(states):
        return scan
    nis = float(states.nis[row])
    if not np.isfinite(states.velocities_m_s[row]).all():
        return replace(scan, nis=nis)
    columns = states.velocities_m_s, states.accel_biases_m_s2, states.gyro_biases_rad_s, states.sigmas
    return replace(scan, nis=nis, inertial=InertialState(*(column[row] for column in columns)))


def _live(folder: Path, data: str | Path | None, stored: StoredRun) -> tuple[SweptScans | None, tuple[str, ...]]:
    """Return the scans of the run's recording, or why there are none."""
    try:
        source = open_map_source(folder, None if data is None else user_path(data))
    except (DataError, ConfigError) as error:
        if data is not None:
            raise
        return None, (f"left out: the points of single scans, as the recording cannot be opened ({error})",)
    return SweptScans(source.sequence, stored.trajectory), ()


def _fixes(record: Record, stored: StoredRun) -> Any:
    fit = stored.metrics.get("gps")
    if fit is None:
        return place_fixes(record, stored.trajectory)
    T = np.array(fit["T_enu_world"], dtype=np.float64)
    return placed_by(record, stored.trajectory, T, float(fit["shift_s"]), [int(k) for k in fit["rejected"]])


def _paths(stored: StoredRun) -> dict[str, Trajectory]:
    reference, first = stored.reference, len(stored.stamps_before)
    if reference is None:
        return {}
    return {REFERENCE: reference_from(reference, first, first + len(stored.trajectory))}


def reference_from(reference: Trajectory, start: int, stop: int) -> Trajectory:
    """Return the reference's poses at a run's scans, in the frame of the run's first."""
    rows = slice(start, stop)
    return Trajectory(reference.stamps_ns[rows], reference.poses[rows]).from_first()


def _clouds(keyframes: LoopKeyframes | None) -> tuple[tuple[int, Floats], ...]:
    rows: Iterable[int] = () if keyframes is None else keyframes.rows.tolist()
    return tuple((row, keyframes.points(k).astype(np.float32)) for k, row in enumerate(rows)) if keyframes else ()
