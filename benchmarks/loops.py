"""Loop closure judged against the truth: ``python benchmarks/loops.py [DATA …] [--seeds N …]``.

DATA are recordings with a reference, or run folders that `hybridlio odometry` made of such. ``--seeds`` simulates towns
and drives that come back to their streets, a scan for each keyframe, with odometry of the noise that it claims: many
in little time. ``--drift`` makes odometry worse than it is, by noise that its covariances tell of, without IMU, so that
loops matter. Times are of the processor, of all threads.

A loop is false when it is off by more than 0.5 m or 1°. A keyframe is a revisit when the vehicle was within 10 m
before, at least 40 m earlier along the path; recall is the share of those that a kept loop ends at.
"""

from __future__ import annotations

import argparse
import time
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

_FALSE_M, _FALSE_DEG = 0.5, 1.0
_REVISIT_M, _APART_M = 10.0, 40.0
_DRIFT_SIGMAS = np.array([1e-4, 1e-4, 5e-4, 0.01, 0.01, 0.003])  # rad, m: a square root of a metre, at --drift 1


@dataclass(frozen=True, eq=False)
class Case:
    """A run with its truth."""

    name: str
    record: Record
    truth: Trajectory
    keyframe_ms_a_scan: float | None = None


def of_recording(path: Path) -> Case:
    if is_run_folder(path):
        record = replace(Record.load(path / RECORD), keyframes=LoopKeyframes.load(path / KEYFRAMES))
        stored = read_run(path)
        assert stored.reference is not None, f"{path}: its recording has no reference"
        return Case(path.name, record, stored.reference)
    sequence = open_sequence(path)
    assert sequence.reference is not None, f"{path}: no reference"
    run = run_odometry(sequence, hl.Odometry())
    assert run.stopped is None
    assert run.record is not None
    return Case(sequence.name, run.record, sequence.reference, 1e3 * float(np.mean(run.timings_s["keyframes"])))


def of_seed(config: hl.SimulationConfig) -> Case:
    """Loop keyframes of a simulated drive, and exact odometry; noise is added by :func:`drifted`."""
    from hybridlio.simulation.measurements import scan_at
    from hybridlio.simulation.plan import plan
    from hybridlio.simulation.rig import T_IMU_LIDAR
    from hybridlio.simulation.sensors.lidar import ray_pattern

    drive, pattern, settings = plan(config), ray_pattern(config.lidar_model), LoopKeyframeSettings()
    poses = drive.path.poses(drive.scan_times_s) @ T_IMU_LIDAR
    poses = se3.between(poses[0], poses)
    maker, last = LoopKeyframeSelector(settings), None
    for k in range(1, len(poses)):
        if last is not None and np.linalg.norm(poses[k, :3, 3] - last) < settings.spacing_m:
            continue
        if maker.offer(k, scan_at(drive, k, pattern, config), poses[k]):
            last = poses[k, :3, 3]
    keyframes = maker.keyframes()
    stamps = keyframes.stamps_ns[0] + (np.arange(len(poses)) - keyframes.rows[0]) * 10**8
    truth = Trajectory(stamps, poses)
    steps = tuple(RelativePose(T, 1e-12 * np.eye(6), "truth") for T in se3.between(poses[:-1], poses[1:]))
    start = start_state(int(stamps[0]), ImuSamples.empty(), ImuNoise())
    record = Record(truth, steps, steps, ImuSamples.empty(), (), start, Calibration(), ImuNoise(), keyframes)
    return Case(f"seed {config.seed}, {config.scene}, {config.lidar}", record, truth)


def drifted(record: Record, times: float, seed: int) -> Record:
    """The run with noise in each step, which its covariances tell of, and without IMU, which would see it."""
    rng = np.random.default_rng(seed)
    steps = []
    for step in record.relative:
        metres = max(float(np.linalg.norm(step.pose[:3, 3])), 0.01)
        sigmas = times * _DRIFT_SIGMAS * np.sqrt(metres)
        pose = step.pose @ se3.exp(sigmas * rng.standard_normal(6))
        own = np.diag(sigmas**2)
        drift = None if step.drift is None else step.drift + own
        steps.append(replace(step, pose=pose, covariance=step.covariance + own, drift=drift, earlier_scans=()))
    poses, covariances = [np.eye(4)], [1e-12 * np.eye(6)]
    for step in steps:
        poses.append(poses[-1] @ step.pose)
        covariances.append(
            se3.compose_covariance(
                covariances[-1], step.pose, step.drift if step.drift is not None else step.covariance
            )
        )
    online = Trajectory(record.online.stamps_ns, np.array(poses), np.array(covariances))
    start = start_state(record.start.stamp_ns, ImuSamples.empty(), record.imu_noise)
    return replace(record, online=online, relative=tuple(steps), imu=ImuSamples.empty(), start=start)


def judge(case: Case, robust: str | None) -> dict[str, str]:
    record = case.record
    begin = time.process_time()
    seconds: dict[str, float] = {}

    def stages(stage: str, done: int, total: int) -> None:
        del done, total
        seconds.setdefault(stage, time.process_time() - begin)

    smoothed = hl.smooth(record, stages, loops=True, robust=robust)
    solve_s = time.process_time() - begin - seconds["optimising"]
    alone = hl.smooth(record)
    closed = smoothed.found["loops"]
    search = closed.search
    wrong = [false_loops(case, loops) for loops in (search.loops, closed.kept)]
    anees = consistency(case, closed.kept)
    before, without, after = (
        hl.evaluate(case.truth, t) for t in (record.online, alone.trajectory, smoothed.trajectory)
    )
    return {
        "case": case.name,
        "scans": f"{len(record.online)}",
        "keyframes": f"{search.keyframes}",
        "candidates": f"{search.candidates}",
        "verified": f"{search.verified}",
        "consistent": f"{len(search.loops)}",
        "kept": f"{len(closed.kept)}",
        "false consistent": f"{wrong[0]}",
        "false kept": f"{wrong[1]}",
        "recall": "{} of {}".format(*recall(case, closed.kept)),
        "ANEES rot, pos": anees,
        "ATE online [m]": f"{before.ate_m:.3f}",
        "ATE smoothed [m]": f"{without.ate_m:.3f}",
        "ATE with loops [m]": f"{after.ate_m:.3f}",
        "finding loops [s]": f"{seconds['optimising']:.1f}",
        "of it verification": f"{search.seconds['verification'] / sum(search.seconds.values()):.0%}",
        "solving [s]": f"{solve_s:.1f}",
        "keyframes [ms a scan]": "" if case.keyframe_ms_a_scan is None else f"{case.keyframe_ms_a_scan:.2f}",
    }


def true_poses(case: Case) -> np.ndarray:
    """``(N, 4, 4)`` at the run's scans."""
    both = associate(case.truth, case.record.online)
    assert len(both.reference) == len(case.record.online), f"{case.name}: scans without truth"
    return both.reference.poses


def errors(case: Case, loops) -> np.ndarray:
    poses = true_poses(case)
    found = np.array([loop.pose for loop in loops]).reshape(-1, 4, 4)
    true = [se3.between(poses[loop.earlier], poses[loop.later]) for loop in loops]
    return se3.log(se3.between(found, np.array(true).reshape(-1, 4, 4)))


def false_loops(case: Case, loops) -> int:
    wrong = errors(case, loops)
    metres, degrees = np.linalg.norm(wrong[:, 3:], axis=1), np.rad2deg(np.linalg.norm(wrong[:, :3], axis=1))
    return int(((metres > _FALSE_M) | (degrees > _FALSE_DEG)).sum())


def consistency(case: Case, loops) -> str:
    if not loops:
        return ""
    judged = pose_consistency(errors(case, loops), np.array([loop.covariance for loop in loops]))
    return f"{judged.rotation.value:.2f}, {judged.position.value:.2f}"


def recall(case: Case, loops) -> tuple[int, int]:
    assert case.record.keyframes is not None
    places = true_poses(case)[:, :3, 3]
    travelled = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1)))
    rows, ends, closed, revisits = case.record.keyframes.rows, {loop.later for loop in loops}, 0, 0
    for k in rows:
        earlier = rows[travelled[rows] < travelled[k] - _APART_M]
        if len(earlier) and np.linalg.norm(places[earlier] - places[k], axis=1).min() < _REVISIT_M:
            revisits += 1
            closed += int(k) in ends
    return closed, revisits


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", nargs="*", type=Path)
    parser.add_argument("--seeds", nargs="*", type=int, default=[])
    parser.add_argument("--length-m", type=float, default=1500.0)
    parser.add_argument("--scene", default="town")
    parser.add_argument("--lidar", default="hdl-64e")
    parser.add_argument("--traffic-per-km", type=float, default=12.0)
    parser.add_argument(
        "--drift", type=float, help="noise added to odometry; 1 is 1 cm and 0.03° a square root of a metre"
    )
    parser.add_argument("--robust")
    words = parser.parse_args()
    rows = []
    for seed in words.seeds:
        config = hl.SimulationConfig(
            seed=seed, length_m=words.length_m, loops=True, speed_m_s=12.0, scene=words.scene, lidar=words.lidar,
            traffic_per_km=words.traffic_per_km,
        )  # fmt: skip
        case = of_seed(config)
        rows.append(judge(replace(case, record=drifted(case.record, words.drift or 1.0, seed)), words.robust))
    for path in words.data:
        case = of_recording(path)
        record = case.record if words.drift is None else drifted(case.record, words.drift, 0)
        rows.append(judge(replace(case, record=record), words.robust))
    for heading in rows[0] if rows else ():
        print(f"{heading:24}", *(f"{row[heading]:>28}" for row in rows))


if __name__ == "__main__":
    main()
