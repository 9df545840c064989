"""Evaluate loop closure against the truth: ``python benchmarks/loops.py [DATA …] [--seeds N …]``.

DATA are recordings with a reference, or run folders of such recordings. ``--seeds`` simulates drives through towns that
return to their streets, with scans at keyframes only and odometry of known noise, which is quick. ``--drift`` adds
noise to the odometry and its covariances, and removes the IMU, so that loops make a difference. Times are processor
time of all threads.

A loop is false if its error exceeds 0.5 m or 1°. A keyframe is a revisit if the vehicle was within 10 m of it at least
40 m earlier along the path. Recall is the share of revisits at which a kept loop ends.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import hybridlio as hl
from hybridlio.core import se3
from hybridlio.core.estimates import RelativePose
from hybridlio.core.sensors import Calibration, ImuNoise, ImuSamples
from hybridlio.core.start_state import start_state
from hybridlio.core.trajectory import Trajectory
from hybridlio.datasets.registry import open_sequence
from hybridlio.evaluation.ate_rpe import associate
from hybridlio.evaluation.consistency import pose_consistency
from hybridlio.record.loop_keyframes import LoopKeyframes, LoopKeyframeSelector, LoopKeyframeSettings
from hybridlio.record.record import Record
from hybridlio.runs.folder import KEYFRAMES, RECORD, is_run_folder, read_run
from hybridlio.runs.run import run_odometry
from hybridlio.smoothing.loops import Loop

Loops = Collection[Loop]

_FALSE_M, _FALSE_DEG = 0.5, 1.0
_REVISIT_M, _MIN_PATH_M = 10.0, 40.0
_DRIFT_SIGMAS = np.array([1e-4, 1e-4, 5e-4, 0.01, 0.01, 0.003])  # with --drift 1, in rad/√m and m/√m


@dataclass(frozen=True, eq=False)
class Case:
    """A run with its truth. ``keyframe_ms`` is the mean time of keyframes for each scan, if measured."""

    name: str
    record: Record
    truth: Trajectory
    keyframe_ms: float | None = None


def case_of_recording(path: Path) -> Case:
    if is_run_folder(path):
        record = replace(Record.load(path / RECORD), keyframes=LoopKeyframes.load(path / KEYFRAMES))
        stored = read_run(path)
        assert stored.reference is not None, f"{path}: the recording of this run has no reference"
        return Case(path.name, record, stored.reference)
    sequence = open_sequence(path)
    assert sequence.reference is not None, f"{path}: this recording has no reference"
    run = run_odometry(sequence, hl.Odometry())
    assert run.stopped is None
    assert run.record is not None
    return Case(sequence.name, run.record, sequence.reference, 1e3 * float(np.mean(run.timings_s["keyframes"])))


def case_of_simulation(config: hl.SimulationConfig) -> Case:
    """Simulate the loop keyframes of a drive, with exact odometry; :func:`with_drift` adds noise."""
    from hybridlio.simulation.measurements import scan_at
    from hybridlio.simulation.plan import plan
    from hybridlio.simulation.rig import T_IMU_LIDAR
    from hybridlio.simulation.sensors.lidar import ray_pattern

    drive, pattern, settings = plan(config), ray_pattern(config.lidar_model), LoopKeyframeSettings()
    poses = drive.path.poses(drive.scan_times_s) @ T_IMU_LIDAR
    poses = se3.between(poses[0], poses)
    selector, last = LoopKeyframeSelector(settings), None
    for k in range(1, len(poses)):
        if last is not None and np.linalg.norm(poses[k, :3, 3] - last) < settings.spacing_m:
            continue
        if selector.offer(k, scan_at(drive, k, pattern, config), poses[k]):
            last = poses[k, :3, 3]
    keyframes = selector.keyframes()
    stamps = keyframes.stamps_ns[0] + (np.arange(len(poses)) - keyframes.rows[0]) * 10**8
    truth = Trajectory(stamps, poses)
    steps = tuple(RelativePose(T, 1e-12 * np.eye(6), "truth") for T in se3.between(poses[:-1], poses[1:]))
    start = start_state(int(stamps[0]), ImuSamples.empty(), ImuNoise())
    record = Record(truth, steps, steps, ImuSamples.empty(), (), start, Calibration(), ImuNoise(), keyframes)
    return Case(f"seed {config.seed}, {config.scene}, {config.lidar}", record, truth)


def with_drift(record: Record, times: float, seed: int) -> Record:
    """Return the run with noise added to its steps and covariances, and without IMU, which would reveal the noise."""
    rng = np.random.default_rng(seed)
    steps = []
    for step in record.relative:
        metres = max(float(np.linalg.norm(step.pose[:3, 3])), 0.01)
        sigmas = times * _DRIFT_SIGMAS * np.sqrt(metres)
        pose = step.pose @ se3.exp(sigmas * rng.standard_normal(6))
        added = np.diag(sigmas**2)
        drift = None if step.drift is None else step.drift + added
        steps.append(replace(step, pose=pose, covariance=step.covariance + added, drift=drift, earlier_scans=()))
    poses, covariances = [np.eye(4)], [1e-12 * np.eye(6)]
    for step in steps:
        poses.append(poses[-1] @ step.pose)
        growth = step.covariance if step.drift is None else step.drift
        covariances.append(se3.compose_covariance(covariances[-1], step.pose, growth))
    online = Trajectory(record.online.stamps_ns, np.array(poses), np.array(covariances))
    start = start_state(record.start.stamp_ns, ImuSamples.empty(), record.imu_noise)
    return replace(record, online=online, relative=tuple(steps), imu=ImuSamples.empty(), start=start)


def evaluate(case: Case, robust: str | None) -> dict[str, str]:
    """Smooth a run with loops and return its column of the table."""
    record = case.record
    begin = time.process_time()
    seconds: dict[str, float] = {}

    def stages(stage: str, done: int, total: int) -> None:
        del done, total
        seconds.setdefault(stage, time.process_time() - begin)

    smoothed = hl.smooth(record, stages, loops=True, robust=robust)
    solve_s = time.process_time() - begin - seconds["optimising"]
    without_loops = hl.smooth(record)
    closed = smoothed.found["loops"]
    search = closed.search
    online, without, with_loops = (
        hl.evaluate(t, case.truth).ate_m for t in (record.online, without_loops.trajectory, smoothed.trajectory)
    )
    return {
        "case": case.name,
        "scans": f"{len(record.online)}",
        "keyframes": f"{search.keyframes}",
        "candidates": f"{search.candidates}",
        "verified": f"{search.verified}",
        "consistent": f"{len(search.loops)}",
        "kept": f"{len(closed.kept)}",
        "false consistent": f"{count_false(case, search.loops)}",
        "false kept": f"{count_false(case, closed.kept)}",
        "recall": "{} of {}".format(*recall(case, closed.kept)),
        "ANEES rotation, position": anees(case, closed.kept),
        "ATE online [m]": f"{online:.3f}",
        "ATE smoothed [m]": f"{without:.3f}",
        "ATE with loops [m]": f"{with_loops:.3f}",
        "loop search [s]": f"{seconds['optimising']:.1f}",
        "of which verification": f"{search.seconds['verification'] / sum(search.seconds.values()):.0%}",
        "solving [s]": f"{solve_s:.1f}",
        "keyframes [ms/scan]": "" if case.keyframe_ms is None else f"{case.keyframe_ms:.2f}",
    }


def true_poses(case: Case) -> np.ndarray:
    """Return the true poses ``(N, 4, 4)`` at the run's scans."""
    both = associate(case.record.online, case.truth)
    assert len(both.reference) == len(case.record.online), f"{case.name}: some scans have no true pose"
    return both.reference.poses


def errors(case: Case, loops: Loops) -> np.ndarray:
    poses = true_poses(case)
    found = np.array([loop.pose for loop in loops]).reshape(-1, 4, 4)
    true = [se3.between(poses[loop.earlier], poses[loop.later]) for loop in loops]
    return se3.log(se3.between(found, np.array(true).reshape(-1, 4, 4)))


def count_false(case: Case, loops: Loops) -> int:
    error = errors(case, loops)
    metres, degrees = np.linalg.norm(error[:, 3:], axis=1), np.rad2deg(np.linalg.norm(error[:, :3], axis=1))
    return int(((metres > _FALSE_M) | (degrees > _FALSE_DEG)).sum())


def anees(case: Case, loops: Loops) -> str:
    if not loops:
        return ""
    found = pose_consistency(errors(case, loops), np.array([loop.covariance for loop in loops]))
    return f"{found.rotation.value:.2f}, {found.position.value:.2f}"


def recall(case: Case, loops: Loops) -> tuple[int, int]:
    """Return how many revisits a loop closes, and how many there are."""
    assert case.record.keyframes is not None
    positions = true_poses(case)[:, :3, 3]
    path_m = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1)))
    rows, ends, closed, revisits = case.record.keyframes.rows, {loop.later for loop in loops}, 0, 0
    for k in rows:
        earlier = rows[path_m[rows] < path_m[k] - _MIN_PATH_M]
        if len(earlier) and np.linalg.norm(positions[earlier] - positions[k], axis=1).min() < _REVISIT_M:
            revisits += 1
            closed += int(k) in ends
    return closed, revisits


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", nargs="*", type=Path, help="recordings or run folders")
    parser.add_argument("--seeds", nargs="*", type=int, default=[], help="of simulated drives")
    parser.add_argument("--length-m", type=float, default=1500.0, help="of a simulated drive (default: %(default)s)")
    parser.add_argument("--scene", default="town", help="of a simulated drive (default: %(default)s)")
    parser.add_argument("--lidar", default="hdl-64e", help="of a simulated drive (default: %(default)s)")
    parser.add_argument("--traffic-per-km", type=float, default=12.0, help="moving cars (default: %(default)s)")
    parser.add_argument("--drift", type=float, help="noise added to the odometry; 1 is 1 cm/√m and 0.03°/√m")
    parser.add_argument("--robust", help="how smoothing treats wrong loops, see `hybridlio smooth --help`")
    options = parser.parse_args()
    columns = []
    for seed in options.seeds:
        config = hl.SimulationConfig(
            seed=seed, length_m=options.length_m, loops=True, speed_m_s=12.0, scene=options.scene, lidar=options.lidar,
            traffic_per_km=options.traffic_per_km,
        )  # fmt: skip
        case = case_of_simulation(config)
        record = with_drift(case.record, options.drift or 1.0, seed)
        columns.append(evaluate(replace(case, record=record), options.robust))
    for path in options.data:
        case = case_of_recording(path)
        record = case.record if options.drift is None else with_drift(case.record, options.drift, 0)
        columns.append(evaluate(replace(case, record=record), options.robust))
    for heading in columns[0] if columns else ():
        print(f"{heading:24}", *(f"{column[heading]:>28}" for column in columns))


if __name__ == "__main__":
    main()
