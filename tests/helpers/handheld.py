"""A lidar and an IMU carried by hand through a room: scans, samples and the true path, whose mounting is known."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from rooms import ROOM, scene, seen_from

from hybridlio.core import se3
from hybridlio.core.pose_interpolation import PosePath
from hybridlio.core.sensors import Calibration, ImuSamples, Scan
from hybridlio.core.trajectory import Trajectory
from hybridlio.datasets.sequence import Sequence

MOUNTING = se3.exp([0.0, 0.0, 0.4, 0.1, -0.05, 0.2])
_STEP_S = 1e-3


@dataclass(frozen=True)
class Handheld:
    """A recording of some seconds.

    Attributes:
        path: ``T_world_lidar`` at 10 Hz.
        imu: samples at 100 Hz, on the same clock.
        fine: ``T_world_lidar`` at 100 Hz.
    """

    path: Trajectory
    imu: ImuSamples
    fine: Trajectory


def carried(rng: np.random.Generator, seconds: float = 12.0, turning: float = 1.0) -> Handheld:
    """Return a walk with turns of up to ``turning`` rad/s about the vertical, half of it about the other axes."""
    times = np.arange(-1, seconds + 1, _STEP_S)
    swing = np.column_stack(
        [
            0.5 * np.sin(1.7 * times + 0.4),
            0.5 * np.sin(2.3 * times),
            np.sin(0.9 * times + 1) + 0.3 * np.sin(3.1 * times),
        ]
    )
    rates = turning * swing
    turns = se3.so3_exp((rates[1:] + rates[:-1]) / 2 * _STEP_S)
    R = [np.eye(3)]
    for turn in turns:
        R.append(R[-1] @ turn)
    rotations = np.array(R)
    positions = np.column_stack([2 * np.sin(0.7 * times), 1.5 * np.sin(0.9 * times), 0.2 * np.sin(2 * times)])
    accelerations = np.gradient(np.gradient(positions, _STEP_S, axis=0), _STEP_S, axis=0)
    force = (np.swapaxes(rotations, 1, 2) @ (accelerations + np.array([0, 0, 9.81]))[..., None])[..., 0]
    fast = slice(200, -200, 10)
    stamps = np.round(times * 1e9).astype(np.int64)
    noise = rng.normal(0, [[1e-3] * 3 + [0.02] * 3], (len(stamps[fast]), 6))
    imu = ImuSamples(stamps[fast], rates[fast] + 0.004 + noise[:, :3], force[fast] + noise[:, 3:])
    slow = slice(1000, round((seconds + 1) / _STEP_S), 100)
    path, fine = (Trajectory(stamps[k], se3.make(rotations[k], positions[k]) @ MOUNTING) for k in (slow, fast))
    return Handheld(path, imu, fine)


def as_sequence(
    rng: np.random.Generator, recording: Handheld, imu: ImuSamples | None = None, T_imu_lidar: np.ndarray = MOUNTING
) -> Sequence:
    """Return the recording with scans of a room, and with samples and a mounting that may be wrong."""
    points, _ = scene(rng, ROOM, count=1200)
    path = recording.path

    def load(k: int) -> Scan:
        seen = seen_from(path.poses[k], points) + np.random.default_rng(k).normal(0, 0.01, points.shape)
        return Scan(int(path.stamps_ns[k]), seen.astype(np.float32))

    return Sequence(
        "walk", path.stamps_ns, load, imu=recording.imu if imu is None else imu, calibration=Calibration(T_imu_lidar)
    )


def swept(rng: np.random.Generator, recording: Handheld, imu: ImuSamples) -> Sequence:
    """Return the recording with scans whose points are measured one after the other in 0.09 s from the stamp on."""
    points, _ = scene(rng, ROOM, count=2000)
    points = points[rng.permutation(len(points))]
    offsets_ns = np.linspace(0, 90_000_000, len(points)).astype(np.int64)
    path, fine = recording.path, PosePath(recording.fine.stamps_ns, recording.fine.poses)

    def load(k: int) -> Scan:
        stamp_ns = int(path.stamps_ns[k])
        there = se3.inverse(fine.at(stamp_ns + offsets_ns))
        seen = np.einsum("nij,nj->ni", there[:, :3, :3], points) + there[:, :3, 3]
        noisy = seen + np.random.default_rng(k).normal(0, 0.01, points.shape)
        return Scan(stamp_ns, noisy.astype(np.float32), None, offsets_ns.astype(np.int32))

    return Sequence("walk", path.stamps_ns, load, imu=imu, calibration=Calibration(MOUNTING))


def changed(imu: ImuSamples, gyro: Callable | None = None, accel: Callable | None = None) -> ImuSamples:
    """Return the samples with functions applied to their columns."""
    return ImuSamples(
        imu.stamps_ns,
        imu.gyro_rad_s if gyro is None else gyro(imu.gyro_rad_s),
        imu.accel_m_s2 if accel is None else accel(imu.accel_m_s2),
    )
