"""The input of a run's report, from the run or from its folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Index
from hybridlio.core.sensors import NS_PER_S
from hybridlio.core.trajectory import Trajectory
from hybridlio.evaluation.evaluate import Steps
from hybridlio.evaluation.reference_check import reference_doubts
from hybridlio.evaluation.report_data import ReportData
from hybridlio.odometry.config import Config
from hybridlio.record.loop_keyframes import LoopKeyframes
from hybridlio.record.record import Record
from hybridlio.runs.folder import KEYFRAMES, StoredRun
from hybridlio.runs.results.states import States
from hybridlio.runs.run import Run
from hybridlio.smoothing.gps_alignment import fix_stamps
from hybridlio.sources.gate.gate_result import Verdict

if TYPE_CHECKING:
    from hybridlio.smoothing.gps_options import GpsFit
    from hybridlio.smoothing.loops import ClosedLoops, Loop
    from hybridlio.smoothing.smoothed import Smoothed

ONLINE, SMOOTHED = "odometry", "smoothed"
_NO_CONFLICT = ("untested", "accepted")


def report_data(
    run: Run,
    record: Record | None,
    config: Config,
    config_text: str,
    notes: Sequence[str],
    forward_speed_length_m: float | None,
) -> ReportData:
    """Return the input of the run's report.

    Args:
        run: the run, complete or not.
        record: the run's, which takes long to make; None for fewer than two estimates.
        config: its settings.
        config_text: the settings as YAML.
        notes: what a reader should know first.
        forward_speed_length_m: path length of the IMU by the vehicle's own forward speed, if known.
    """
    trajectory = run.trajectory
    return ReportData(
        name=run.sequence.name,
        estimate=trajectory,
        reference=run.sequence.reference,
        estimate_name=ONLINE,
        initial_poses=run.initial_poses,
        final_poses=run.steps.poses,
        step_covariances=run.steps.covariances,
        timings_s=run.timings_s,
        ok=run.ok,
        degenerate=run.degenerate,
        conflicts=_conflicts(run),
        map_points=None if record is None else _map_points(record, trajectory),
        reference_doubts=_reference_doubts(run, forward_speed_length_m),
        first_scan=run.skipped,
        **_biases(States.of_estimates(run.estimates)),
        facts={"initial pose": config.initial_pose, "residual": config.residual, "backend": config.backend},
        config=config_text,
        warnings=notes,
    )


def smoothed_report_data(
    stored: StoredRun, record: Record, smoothed: Smoothed, steps: Steps, loops: Sequence[Loop]
) -> ReportData:
    """Return the input of the report of a smoothed run.

    Args:
        stored: the run before smoothing.
        record: of the run.
        smoothed: the result.
        steps: the smoothed relative poses.
        loops: the loops that were closed.
    """
    fit: GpsFit | None = smoothed.found.get("gps")
    closed: ClosedLoops | None = smoothed.found.get("loops")
    return ReportData(
        name=stored.metrics["sequence"],
        estimate=smoothed.trajectory,
        reference=stored.reference,
        estimate_name=SMOOTHED,
        others={ONLINE: stored.trajectory},
        final_poses=steps.poses,
        step_covariances=steps.covariances,
        ok=np.array([step.ok for step in record.relative]),
        degenerate=np.array([len(step.degenerate) > 0 for step in record.relative]),
        map_points=_map_points(record, smoothed.trajectory, stored),
        **({} if fit is None else _fixes(record, smoothed.trajectory, fit)),
        **_biases(States.of_smoothed(smoothed, record)),
        reference_doubts=stored.metrics.get("reference_doubts", ()),
        first_scan=len(stored.stamps_before),
        loops=np.array([(loop.earlier, loop.later) for loop in loops], np.int64).reshape(-1, 2),
        facts={"smoothed": f"{smoothed.iterations} iterations", "run": stored.path.name}
        | {"fit": smoothed.verdict.summary()}
        | ({} if closed is None else {"loops": closed.summary()})
        | ({} if fit is None else {"GPS": fit.summary()}),
        warnings=[*stored.metrics["notes"], *smoothed.verdict.doubts],
    )


def _conflicts(run: Run) -> dict[str, Index]:
    """Return the rows of the estimates whose scan conflicts with the IMU, by verdict of the innovation gate."""
    verdicts: list[Verdict] = [v for v in get_args(Verdict) if v not in _NO_CONFLICT]
    rows = {str(v): np.array(run.frames_with(v), np.int64) - run.skipped for v in verdicts}
    return {verdict: found for verdict, found in rows.items() if len(found)}


def _map_points(record: Record, trajectory: Trajectory, stored: StoredRun | None = None) -> Array | None:
    """Return the points ``(P, 3)`` of the loop keyframes in the trajectory's frame; None if there are none."""
    return _placed(record.keyframes if stored is None else _stored_keyframes(stored.path), trajectory)


def stored_map_points(path: Path, trajectory: Trajectory) -> Array | None:
    """Return the points ``(P, 3)`` of a run's loop keyframes in its trajectory's frame; None if ``path`` has none."""
    return _placed(_stored_keyframes(path), trajectory)


def _placed(keyframes: LoopKeyframes | None, trajectory: Trajectory) -> Array | None:
    if keyframes is None or not len(keyframes) or keyframes.rows.max() >= len(trajectory):
        return None
    rows = keyframes.rows.tolist()
    return np.concatenate([se3.transform(trajectory.poses[row], keyframes.points(k)) for k, row in enumerate(rows)])


def _stored_keyframes(folder: Path) -> LoopKeyframes | None:
    path = folder / KEYFRAMES
    return LoopKeyframes.load(path) if path.is_file() else None


def _fixes(record: Record, trajectory: Trajectory, fit: GpsFit) -> dict[str, Any]:
    """Return what the report shows of the fixes that smoothing used, in the trajectory's frame."""
    used = np.flatnonzero(fit.used)
    fixes = [record.gps[k] for k in used]
    T = se3.inverse(fit.T_enu_world)
    positions = np.array([fix.position_m for fix in fixes]).reshape(-1, 3)
    covariances = np.array([fix.covariance_m2 for fix in fixes]).reshape(-1, 3, 3)
    since_ns = fix_stamps(fixes, fit.shift_s) - trajectory.stamps_ns[0]
    return {
        "fixes_m": np.asarray(se3.transform(T, positions)),
        "fix_covariances_m2": fit.noise_scale**2 * T[:3, :3] @ covariances @ T[:3, :3].T,
        "fix_times_s": since_ns / NS_PER_S,
        "fix_residuals_m": fit.residuals_m[used],
    }


def _biases(states: States | None) -> dict[str, Any]:
    """Return what the report shows of the IMU's biases."""
    if states is None:
        return {}
    biases = np.concatenate([states.accel_biases_m_s2, states.gyro_biases_rad_s], axis=1)
    return {"biases": biases, "bias_sigmas": states.sigmas[:, 3:]}


def _reference_doubts(run: Run, forward_speed_length_m: float | None) -> list[str]:
    reference = run.sequence.reference
    if reference is None:
        return []
    poses = reference.poses[run.skipped : run.done] @ se3.inverse(run.sequence.calibration.T_imu_lidar)
    length_m = float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum())
    return reference_doubts(reference, length_m, forward_speed_length_m)
