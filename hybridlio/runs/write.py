"""Write a run folder: poses, covariances, graph, record, metrics and report."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from hybridlio.core import se3
from hybridlio.core.errors import EstimationError
from hybridlio.core.files import write_atomically
from hybridlio.core.sensors import NS_PER_S
from hybridlio.core.tables import counted
from hybridlio.core.trajectory import write_tum
from hybridlio.core.version import __version__
from hybridlio.datasets.notes import labelled
from hybridlio.datasets.protection import check_output
from hybridlio.evaluation.evaluate import Evaluation, Steps
from hybridlio.evaluation.report import picture, write_report
from hybridlio.evaluation.report_data import Findings, ReportData, analyse
from hybridlio.odometry.config import Config, config_to_yaml
from hybridlio.record.record import Record
from hybridlio.runs import folder as run_folder
from hybridlio.runs.own_files import check_free
from hybridlio.runs.results.mounting import mounting_doubts
from hybridlio.runs.results.report_input import ONLINE, SMOOTHED, report_data, smoothed_report_data
from hybridlio.runs.results.states import States
from hybridlio.runs.run import Run
from hybridlio.runs.whole_folder import is_held, replaced_folder

if TYPE_CHECKING:
    from hybridlio.smoothing.gps_options import GpsFit
    from hybridlio.smoothing.loops import ClosedLoops, Loop
    from hybridlio.smoothing.smoothed import Smoothed
    from hybridlio.sources.gate.gate_result import Verdict

_MAX_SCANS_NOTED = 20  # unreadable scans listed in the report; metrics.json has them all
_LARGE_SHARE = 0.1  # of all scans; more conflicts with the IMU than single bad scans explain


def write_run(folder: Path, run: Run, config: Config) -> Findings:
    """Write all files of a run, complete or interrupted, to a folder that appears whole or replaces an earlier run.

    Files in the folder that no run has are kept. The journal of an interrupted run stays with it.

    Returns:
        The evaluation of the run.

    Raises:
        EstimationError: the run has no estimate.
        ConfigError: the folder is no run folder, touches a recording, or is being written by another process.
        DataError: a file cannot be written.
    """
    _check_folder(folder)
    with replaced_folder(folder, run_folder.is_own_file, lambda: run.stopped is not None) as part:
        return write_run_files(part, run, config)


def _check_folder(folder: Path) -> None:
    if not is_held(folder):  # who holds it has checked it
        check_output(folder)
        check_free(folder, overwrite=True)


def write_run_files(folder: Path, run: Run, config: Config) -> Findings:
    """Write all files of a run to an empty folder; see :func:`write_run`, which callers want."""
    if not run.estimates:
        raise EstimationError(f"{run.sequence.name}: the run has no estimate to write")
    sequence, trajectory, record = run.sequence, run.trajectory, run.record
    if record is not None:
        record.save(folder / run_folder.RECORD)
        if record.keyframes is not None:
            record.keyframes.save(folder / run_folder.KEYFRAMES)
        run_folder.write_graph(folder, trajectory.poses, record.edges, run.skipped)
    run_folder.write_trajectory(folder, trajectory, T_pose_files(run), run.steps, run.stamps_before)
    States.of_estimates(run.estimates).save(folder / run_folder.STATES)
    if sequence.reference is not None:
        write_tum(folder / run_folder.REFERENCE, sequence.reference)
    text = config_to_yaml(config)
    write_atomically(folder / run_folder.CONFIG, text)
    data = report_data(run, record, config, text, notes(run), forward_speed_length_m(run))
    findings = analyse(data)
    write_pages(folder, data, findings)
    doubts = {"reference_doubts": list(data.reference_doubts)}
    run_folder.write_metrics(folder, metrics(run, config, findings.evaluations.get(ONLINE)) | doubts)
    return findings


def write_pages(folder: Path, data: ReportData, findings: Findings) -> None:
    """Write ``report.html``, and the plot of the trajectory as ``trajectory.png``."""
    write_report(folder / run_folder.REPORT, data, findings)
    write_atomically(folder / run_folder.PICTURE, picture(data, findings))


def T_pose_files(run: Run) -> Any:
    """Return ``T_camera_lidar`` if the recording's KITTI pose files are in the camera frame, else None."""
    sequence = run.sequence
    return sequence.calibration.T_camera_lidar if sequence.pose_file_frame == "camera" else None


def notes(run: Run) -> list[str]:
    """Return what a reader of the results should know first, such as scans that could not be used."""
    out = labelled(run.sequence.notes)
    if run.stopped is not None:
        cause = "interrupted" if isinstance(run.stopped, KeyboardInterrupt) else f"stopped by an error ({run.stopped})"
        out.append(f"{cause} after {run.done} of {len(run.sequence)} scans")
    if run.skipped:
        out.append(f"the run starts at scan {run.skipped}; no earlier scan is usable")
    if run.bridged:
        out.append(f"{counted(len(run.bridged), 'unusable scan')} bridged by the initial pose")
    out += imu_conflicts(run)
    out += mounting_doubts(run)
    listed = [f"frame {k}: {reason}" for k, reason in run.unreadable.items()]
    more = len(listed) - _MAX_SCANS_NOTED
    return out + listed[:_MAX_SCANS_NOTED] + ([f"and {more} more"] if more > 0 else [])


def imu_conflicts(run: Run) -> list[str]:
    """Return one line per verdict of the innovation gate: how many scans conflict with the IMU and what was done."""
    actions = {
        "rejected": "rejected: they conflict with the IMU, which bridges them",
        "relocated": "used to relocate in the map after repeated rejections; the jump is not in the trajectory",
        "down-weighted": "down-weighted, as the difference from the IMU is more than the covariances explain",
        "undecided": "left out, with the IMU, as either may be wrong; the next scan decides",
        "IMU left out": "used without the IMU, which contradicted the smooth motion that scans show",
    }
    counts = {action: len(run.frames_with(cast("Verdict", verdict))) for verdict, action in actions.items()}
    out = [f"{counted(count, 'scan')} {action}" for action, count in counts.items() if count]
    conflicts = len(run.frames_with("rejected")) + len(run.frames_with("IMU left out"))
    if conflicts > _LARGE_SHARE * len(run.estimates):
        out.append("many scans conflict with the IMU; its data may be wrong: check T_imu_lidar, units and clock")
    return out


def metrics(run: Run, config: Config, evaluation: Evaluation | None) -> dict[str, Any]:
    """Return the content of ``metrics.json``: settings, counts, times and, with a reference, errors."""
    T = T_pose_files(run)
    out: dict[str, Any] = {
        "hybridlio": __version__,
        "sequence": run.sequence.name,
        "initial_pose": config.initial_pose,
        "residual": config.residual,
        "backend": config.backend,
        "frames": len(run.sequence),
        "frames_done": run.done,
        "interrupted": run.stopped is not None,
        "skipped": run.skipped,
        "bridged": run.bridged,
        "rejected": run.frames_with("rejected"),
        "down_weighted": run.frames_with("down-weighted"),
        "relocated": run.frames_with("relocated"),
        "undecided": run.frames_with("undecided"),
        "imu_left_out": run.frames_with("IMU left out"),
        "degenerate": (np.flatnonzero(run.degenerate) + run.skipped + 1).tolist(),
        "unreadable": {str(k): why for k, why in run.unreadable.items()},
        "notes": notes(run),
        "imu_time_offset_s": run.sequence.imu_time_offset_s,
        "path_length_m": run.trajectory.length_m,
        "forward_speed_length_m": forward_speed_length_m(run),
        "imu_path_length_m": imu_path_length_m(run),
        "seconds": run.seconds,
        "ms_per_scan": ms_per_scan(run),
        "pose_file_frame": run.sequence.pose_file_frame,
    }
    if run.sequence.source is not None:
        out["recording"] = run.sequence.source.to_json_dict()
    if T is not None:
        out["T_camera_lidar"] = T.tolist()
    return out | (evaluation.to_json_dict() if evaluation is not None else {})


def ms_per_scan(run: Run) -> dict[str, float]:
    """Return the median milliseconds per scan by stage, and ``total`` without reading; empty for a single estimate."""
    stages = run.timings_s
    if not stages:
        return {}
    total = np.sum([spent for stage, spent in stages.items() if stage != "reading"], axis=0)
    return {stage: 1e3 * float(np.median(spent)) for stage, spent in {**stages, "total": total}.items()}


def forward_speed_length_m(run: Run) -> float | None:
    """Return the path length by the vehicle's own forward speed (trapezoidal rule), or None if it is unknown."""
    speed = run.sequence.forward_speed_m_s
    if speed is None or len(run.estimates) < 2:
        return None
    rows = slice(run.skipped, run.done)
    return float(np.trapezoid(speed[rows], run.sequence.stamps_ns[rows] / NS_PER_S))


def imu_path_length_m(run: Run) -> float:
    """Return the estimated path length of the IMU, to compare with the forward speed, which is that of the IMU.

    In bends it differs from the path length of the lidar.
    """
    poses = run.trajectory.poses @ se3.inverse(run.sequence.calibration.T_imu_lidar)
    return float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum())


def write_smoothed(folder: Path, stored: run_folder.StoredRun, record: Record, smoothed: Smoothed) -> Findings:
    """Write a smoothed run as a run folder, with a report that shows the trajectory before and after smoothing.

    Returns:
        The evaluation of both trajectories.

    Raises:
        ConfigError: the folder is no run folder, touches a recording, or is being written by another process.
        DataError: a file cannot be written.
    """
    _check_folder(folder)
    with replaced_folder(folder, run_folder.is_own_file) as part:
        return _write_smoothed_files(part, stored, record, smoothed)


def _write_smoothed_files(folder: Path, stored: run_folder.StoredRun, record: Record, smoothed: Smoothed) -> Findings:
    trajectory, T = smoothed.trajectory, stored.T_camera_lidar
    steps = Steps(se3.between(trajectory.poses[:-1], trajectory.poses[1:]), smoothed.step_covariances)
    run_folder.write_trajectory(folder, trajectory, T, steps, stored.stamps_before)
    states = States.of_smoothed(smoothed, record)
    if states is not None:
        states.save(folder / run_folder.STATES)
    loops = _closed_loops(smoothed)
    edges = [*record.edges, *((loop.earlier, loop.later, loop.as_relative_pose()) for loop in loops)]
    run_folder.write_graph(folder, trajectory.poses, edges, len(stored.stamps_before))
    if stored.reference is not None:
        write_tum(folder / run_folder.REFERENCE, stored.reference)
    findings = analyse(data := smoothed_report_data(stored, record, smoothed, steps, loops))
    write_pages(folder, data, findings)
    run_folder.write_metrics(folder, _smoothed_metrics(stored, smoothed, findings.evaluations.get(SMOOTHED)))
    return findings


def _closed_loops(smoothed: Smoothed) -> tuple[Loop, ...]:
    closed: ClosedLoops | None = smoothed.found.get("loops")
    return () if closed is None else closed.kept


def _smoothed_metrics(
    stored: run_folder.StoredRun, smoothed: Smoothed, evaluation: Evaluation | None
) -> dict[str, Any]:
    fit: GpsFit | None = smoothed.found.get("gps")
    closed: ClosedLoops | None = smoothed.found.get("loops")
    kept = ("recording", "hybridlio", "sequence", "pose_file_frame", "T_camera_lidar", "frames", "frames_done", "notes")
    figures = {name: stored.metrics[name] for name in kept if name in stored.metrics}
    figures |= {name: getattr(smoothed, name) for name in ("error_before", "error_after", "iterations", "converged")}
    figures |= {"path_length_m": smoothed.trajectory.length_m, "verdict": smoothed.verdict.to_json_dict()}
    if closed is not None:
        figures |= {"loops": closed.to_json_dict(len(stored.stamps_before))}
    if fit is not None:
        figures |= {"gps": fit.to_json_dict()}
    if (calibrated := smoothed.found.get("calibration")) is not None:
        figures |= {"calibration": calibrated.to_json_dict()}
    return figures | (evaluation.to_json_dict() if evaluation is not None else {})
