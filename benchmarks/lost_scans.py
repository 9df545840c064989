"""Measure initial poses where scans are lost: the motion over 1, 3 and 10 s by the IMU alone, from the graph's state.

    python benchmarks/lost_scans.py FOLDER [--kinds campus-handheld,campus-drone] [--seeds 1,2] [--seconds 60]

Each kind and seed gives two recordings of one place, simulated below FOLDER unless they are there. Their IMU has the
sensitivity errors of a consumer MEMS part (`faults.imu_scale_error`). The scale is found on the first recording
(`find_imu_scale`, from the path that the scans give, without labels) and used on the second. Odometry runs over the
second with all scans; every two seconds the motion over the time that follows is predicted as if no scan came:

* `preintegration`: samples as recorded;
* `lstm`: the shipped LSTMs, which take the velocity of the last step;
* `preintegration, scale found`: samples corrected by the scale of the first recording;
* `preintegration, exact IMU`: the same recording without the errors of sensitivity, the least that can be left.

Prints root mean square errors of rotation and position, and the normalised squared error over its 6 dimensions.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from hybridlio.calibration.imu_scale import FoundScale, find_imu_scale
from hybridlio.commands.terminal import progress
from hybridlio.core import se3, tables
from hybridlio.core.arrays import Array
from hybridlio.core.estimates import InitialPoseSource, RelativePose, State
from hybridlio.core.imu_scale import KNOWN_SCALE_SIGMA, ImuScale
from hybridlio.core.sensors import NS_PER_S, Frame, ImuNoise, Scan
from hybridlio.datasets.registry import open_sequence
from hybridlio.datasets.sequence import Sequence
from hybridlio.graph.run.inertial_steps import InertialSteps
from hybridlio.learned.sources.lstm_initial_pose import LstmInitialPose
from hybridlio.odometry.estimate import trajectory_of
from hybridlio.odometry.odometry import Odometry
from hybridlio.simulation.faults import imu_scale_error
from hybridlio.simulation.platforms.config import PlatformConfig
from hybridlio.simulation.platforms.simulate import simulate_platform

GAPS_S = (1.0, 3.0, 10.0)
EVERY_S, FIRST_S = 2.0, 10.0  # the graph knows the biases by then
Errors = dict[float, list[tuple[float, float, float]]]


def recording(folder: Path, kind: str, lidar: str, seed: int, drive_seed: int, seconds: float) -> Sequence:
    """Return a simulated recording; the two of one seed have the same IMU, of wrong sensitivities."""
    scene, platform = kind.split("-")
    config = PlatformConfig(
        scene=scene, platform=platform, lidar=lidar, seed=seed, drive_seed=drive_seed, seconds=seconds
    )
    with progress(f"simulating {config.name}") as report:
        return open_sequence(simulate_platform(folder, config, report))


def found_scale(sequence: Sequence) -> FoundScale | None:
    """Find the scale from the path of an odometry run."""
    odometry = Odometry()
    path = trajectory_of([odometry.step(frame) for frame in sequence])
    return find_imu_scale(path, sequence.imu, sequence.calibration.T_imu_lidar)


def gaps(sequence: Sequence, source: str) -> Iterator[tuple[float, RelativePose, int, int]]:
    """Yield predictions over gaps: the length, the relative pose, and the stamps of both ends."""
    odometry, learned, next_s = Odometry(), LstmInitialPose(), FIRST_S
    state: State | None = None
    for frame in sequence:
        if state is not None and source == "lstm":
            learned.predict(frame, state)
        estimate = odometry.step(frame)
        if source == "lstm" and estimate.relative is not None:
            learned.correct(frame, estimate.relative)
        state = odometry.last_state
        if state is None or (frame.scan.stamp_ns - sequence.stamps_ns[0]) / NS_PER_S < next_s:
            continue
        next_s += EVERY_S
        assert odometry.imu_noise is not None
        steps = InertialSteps(sequence.calibration, odometry.imu_noise)
        for gap_s in GAPS_S:
            end_ns = frame.scan.stamp_ns + round(gap_s * NS_PER_S)
            if end_ns > sequence.stamps_ns[-1]:
                continue
            scan = Scan(end_ns, np.empty((0, 3), np.float32))
            later = replace(frame, scan=scan, imu=sequence.imu.between(frame.scan.stamp_ns, end_ns))
            step = predicted(learned if source == "lstm" else None, steps, later, state)
            if step is not None:
                yield gap_s, step, frame.scan.stamp_ns, end_ns


def predicted(
    learned: InitialPoseSource | None, steps: InertialSteps, later: Frame, state: State
) -> RelativePose | None:
    """Return the motion from the state to a later frame."""
    return steps.predicted(later, state) if learned is None else learned.predict(later, state)


def errors_of(sequence: Sequence, source: str) -> Errors:
    """Return errors of rotation [°] and position [m], and the normalised squared error, by length of the gap."""
    reference = sequence.reference
    assert reference is not None
    found: Errors = {gap: [] for gap in GAPS_S}
    for gap_s, step, start_ns, end_ns in gaps(sequence, source):
        at = np.searchsorted(reference.stamps_ns, [start_ns, end_ns])
        start, end = reference.poses[np.minimum(at, len(reference) - 1)]
        error: Array = se3.log(se3.between(step.pose, se3.between(start, end)))
        nees = float(error @ np.linalg.solve(step.covariance, error)) / 6
        found[gap_s].append((float(np.degrees(np.linalg.norm(error[:3]))), float(np.linalg.norm(error[3:])), nees))
    return found


def measure(folder: Path, kind: str, lidar: str, seed: int, seconds: float) -> dict[str, Errors]:
    """Return the errors by source."""
    first, second = (recording(folder, kind, lidar, seed, seed + k, seconds) for k in (1, 2))
    scale = found_scale(imu_scale_error(first, seed=seed))
    wrong = imu_scale_error(second, seed=seed)
    correction = ImuScale() if scale is None else scale.scale
    sources = {
        "preintegration": (wrong, "preintegration"),
        "lstm": (wrong, "lstm"),
        "preintegration, scale found": (
            with_scale_sigma(replace(wrong, imu=correction.corrected(wrong.imu)), KNOWN_SCALE_SIGMA),
            "preintegration",
        ),
        "preintegration, exact IMU": (with_scale_sigma(second, 0.0), "preintegration"),
    }
    return {name: errors_of(sequence, source) for name, (sequence, source) in sources.items()}


def with_scale_sigma(sequence: Sequence, sigma: float) -> Sequence:
    """Return the recording with another standard deviation of its gyroscope's scale."""
    return replace(sequence, imu_noise=replace(sequence.imu_noise or ImuNoise(), gyro_scale_sigma=sigma))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    parser.add_argument("--kinds", default="campus-handheld,campus-drone")
    parser.add_argument("--seeds", default="1,2")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--lidar", default="vlp-16")
    options = parser.parse_args()
    for kind in options.kinds.split(","):
        pooled: dict[str, Errors] = {}
        for seed in map(int, options.seeds.split(",")):
            for name, errors in measure(options.folder, kind, options.lidar, seed, options.seconds).items():
                into = pooled.setdefault(name, {gap: [] for gap in GAPS_S})
                for gap, rows in errors.items():
                    into[gap] += rows
        print(f"\n{kind}, seeds {options.seeds}: rotation [°] / position [m] / NEES after\n")
        print(tables.to_markdown([_row(name, errors) for name, errors in pooled.items()], ("source",)), flush=True)


def _row(name: str, errors: Errors) -> dict[str, str]:
    row = {"source": name}
    for gap, rows in errors.items():
        if rows:
            rms = np.sqrt(np.mean(np.square(rows), axis=0))
            row[f"{gap:g} s"] = f"{rms[0]:.2f} / {rms[1]:.3f} / {np.mean([row[2] for row in rows]):.1f}"
    return row


if __name__ == "__main__":
    main()
