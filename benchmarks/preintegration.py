"""Compare preintegration with ground truth: rotation, translation and NEES over windows of 0.1, 1 and 5 s.

python benchmarks/preintegration.py [DATA]

DATA holds `imu_continuous` (100 Hz, truth at 10 Hz) and `kitti_imu_100hz` with `kitti_odometry` (KITTI 00 from 40 to
190 s, where no samples are interpolated). Without DATA only simulated drives are used.

On simulated drives a window starts at the true velocity, biases and gravity. On recordings these come from smoothing
the truth with the IMU (σ of the truth's steps: 0.5 mrad, 1 cm), so errors over long windows are those of the samples'
noise and of the biases' random walk. NEES is divided by 3; 1 is consistent. Its covariance is the preintegrated one,
and on recordings also that of the velocity (σ 1 cm/s) and of the truth at both ends (σ 0.2 mrad, 1 cm).
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import nanoseconds
from kitti_00 import T_LIDAR_IMU, read
from scipy.spatial.transform import Rotation

import hybridlio as hl
from hybridlio.core import se3
from hybridlio.core.sensors import NS_PER_S
from hybridlio.graph.base.preintegration import covers, predict_step, preintegrate
from hybridlio.record.imu_clock import on_poses_clock
from hybridlio.record.record import Record
from hybridlio.simulation.chain import ChainSettings, make_chain
from hybridlio.smoothing.smoothed import Smoothed

WINDOWS_S = (0.1, 1.0, 5.0)
TRUTH_STEP = np.diag(np.r_[np.full(3, 5e-4), np.full(3, 1e-2)] ** 2)
TRUTH_END = np.diag(np.r_[np.full(3, 2e-4), np.full(3, 1e-2)] ** 2)
VELOCITY_SIGMA_M_S = 1e-2
SEEDS, DRIVE_STEPS = range(500, 520), 200

Window = tuple[hl.State, hl.ImuSamples, np.ndarray]  # state at the start, samples, true step


def simulated(window_s: float) -> Iterator[Window]:
    for seed in SEEDS:
        drive = make_chain(seed, ChainSettings(steps=DRIVE_STEPS))
        imu = drive.record(drive.lidar_poses).imu
        stamps = np.array([frame.scan.stamp_ns for frame in drive.frames])
        span = round(window_s / 0.1)
        for k in range(0, DRIVE_STEPS - span + 1, max(span, 5)):
            state = replace(
                drive.start, stamp_ns=int(stamps[k]), T_world_imu=drive.poses[k], velocity_m_s=drive.velocities[k],
                accel_bias_m_s2=drive.accel_biases[k], gyro_bias_rad_s=drive.gyro_biases[k],
                gravity_m_s2=drive.gravity, covariance=np.zeros((15, 15)), gravity_covariance=np.zeros((3, 3)),
            )  # fmt: skip
            true = se3.between(drive.poses[k], drive.poses[k + span])
            yield state, imu.between(int(stamps[k]), int(stamps[k + span])), true


def recorded(record: Record, window_s: float, smoothed: Smoothed) -> Iterator[Window]:
    """Yield the windows of a record whose odometry is the truth."""
    T = record.calibration.T_imu_lidar
    truth = T @ record.online.poses @ se3.inverse(T)
    stamps = record.online.stamps_ns
    covariance = np.zeros((15, 15))
    covariance[6:9, 6:9] = VELOCITY_SIGMA_M_S**2 * np.eye(3)
    span = round(window_s / float(np.median(np.diff(stamps)) / NS_PER_S))
    R = T[:3, :3] @ smoothed.trajectory.poses[:, :3, :3] @ T[:3, :3].T
    for k in range(0, len(stamps) - span, max(span, 5)):
        imu = record.imu.between(int(stamps[k]), int(stamps[k + span]))
        if not covers(imu, int(stamps[k]), int(stamps[k + span])):
            continue
        # velocity and gravity of the smoothed state, rotated to the truth's attitude
        R_truth_smoothed = truth[k, :3, :3] @ R[k].T
        state = replace(
            record.start, stamp_ns=int(stamps[k]), T_world_imu=truth[k],
            velocity_m_s=R_truth_smoothed @ smoothed.velocities_m_s[k],
            gravity_m_s2=R_truth_smoothed @ smoothed.gravity_m_s2,
            accel_bias_m_s2=smoothed.accel_biases_m_s2[k], gyro_bias_rad_s=smoothed.gyro_biases_rad_s[k],
            covariance=covariance, gravity_covariance=np.zeros((3, 3)),
        )  # fmt: skip
        yield state, imu, se3.between(truth[k], truth[k + span])


def print_row(name: str, window_s: float, windows: Iterator[Window], end_covariance: np.ndarray) -> None:
    noise = hl.ImuNoise()
    errors, whitened = [], []
    for state, imu, true in windows:
        step, covariance = predict_step(preintegrate(imu, state, noise), state)
        error = se3.log(se3.between(step, true))
        first = se3.adjoint(se3.inverse(true))
        covariance = covariance + end_covariance + first @ end_covariance @ first.T
        errors.append(error)
        whitened.append(
            [error[part] @ np.linalg.solve(covariance[part, part], error[part]) / 3 for part in (slice(3), slice(3, 6))]
        )
    rotation, translation = (
        np.sqrt((np.array(errors)[:, part] ** 2).sum(1).mean()) for part in (slice(3), slice(3, 6))
    )
    nees = np.mean(whitened, axis=0)
    print(
        f"| {name} | {window_s:g} | {len(errors)} | {np.degrees(rotation):.4f} | {translation:.4f} "
        f"| {nees[0]:.2f} | {nees[1]:.2f} |",
        flush=True,
    )


def continuous(data: Path) -> Record:
    imu, rows = np.loadtxt(data / "imu_continuous/imu.txt"), np.loadtxt(data / "imu_continuous/traj.txt")
    start = rows[0, 0]
    poses = se3.make(Rotation.from_quat(rows[:, 4:8]).as_matrix(), rows[:, 1:4])
    inside = (rows[:, 0] >= imu[0, 0]) & (rows[:, 0] <= imu[-1, 0])
    samples = hl.ImuSamples(nanoseconds(imu[:, 0] - start), imu[:, 4:7], imu[:, 1:4])
    truth = hl.Trajectory(nanoseconds(rows[inside, 0] - start), poses[inside])
    return Record.from_odometry(truth, samples, covariances=TRUTH_STEP)


def kitti(data: Path) -> Record:
    truth, _, imu, _ = read(data)
    calibration = hl.Calibration(se3.inverse(T_LIDAR_IMU))
    samples = on_poses_clock(truth, imu, calibration).imu
    inside = (truth.times_s > 40) & (truth.times_s < 190)
    part = hl.Trajectory(truth.stamps_ns[inside], truth.poses[inside])
    return Record.from_odometry(part, samples, calibration=calibration, covariances=TRUTH_STEP, imu_time_offset_s=0.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="?", help="the folder of recordings")
    options = parser.parse_args()
    print("| data | window, s | windows | rotation, ° RMS | translation, m RMS | NEES rotation | NEES translation |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for window_s in WINDOWS_S:
        print_row("simulated", window_s, simulated(window_s), np.zeros((6, 6)))
    if options.data is None:
        return
    for name, record in (("imu_continuous", continuous(options.data)), ("KITTI 00", kitti(options.data))):
        smoothed = hl.smooth(record)
        for window_s in WINDOWS_S:
            print_row(name, window_s, recorded(record, window_s, smoothed), TRUTH_END)


if __name__ == "__main__":
    main()
