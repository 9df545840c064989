"""Plain files of a drive: poses of an odometry that drifts, raw samples on a late clock, fixes, wheel speeds, truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml

from hybridlio.core import se3
from hybridlio.core.motion_limits import GRAVITY_M_S2
from hybridlio.core.sensors import NS_PER_S
from hybridlio.core.trajectory import Trajectory, write_kitti, write_tum

IMU_LATE_S = 0.08  # by which stamps of the IMU are later than the poses'
ANTENNA_M = np.array([0.6, -0.4, 1.2])  # in the IMU frame; the file states zero
T_IMU_LIDAR = se3.exp([0.02, -0.01, 0.03, 0.3, 0.1, 0.4])
SECONDS = 30.0


def ride(t: np.ndarray) -> np.ndarray:
    """Return poses ``(N, 4, 4)`` of the IMU of a car that drives forward through bends, up and down, and leans."""
    heading = 0.8 * np.sin(0.35 * t) + 0.3 * np.sin(0.9 * t)
    turn = np.column_stack([0.05 * np.sin(0.8 * t), 0.04 * np.sin(0.6 * t + 1), heading])
    fine = np.linspace(-1, SECONDS + 1, 20_001)
    course = 0.8 * np.sin(0.35 * fine) + 0.3 * np.sin(0.9 * fine)
    speed = 6 + 2 * np.sin(0.5 * fine)
    steps = np.diff(fine, prepend=fine[0])
    x, y = np.cumsum(speed * np.cos(course) * steps), np.cumsum(speed * np.sin(course) * steps)
    from scipy.interpolate import CubicSpline

    place = CubicSpline(fine, np.column_stack([x, y, 0.5 * np.sin(0.4 * fine)]))(t)
    return se3.make(se3.so3_exp([0, 0, 1.0] * turn) @ se3.so3_exp([1, 1, 0.0] * turn), place)


def imu_rows(t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return rows ``t_s, gx, gy, gz, ax, ay, az`` with noise and biases."""
    h = 2e-3
    before, here, after = ride(t - h), ride(t), ride(t + h)
    R = np.swapaxes(here[:, :3, :3], 1, 2)
    gyro = se3.so3_log(np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3]) / (2 * h)
    accel = (after[:, :3, 3] - 2 * here[:, :3, 3] + before[:, :3, 3]) / h**2 + [0, 0, GRAVITY_M_S2]
    force = (R @ accel[..., None])[..., 0]
    gyro = gyro + [0.002, -0.001, 0.003] + 2e-3 * rng.standard_normal(gyro.shape)
    return np.column_stack([t, gyro, force + [0.05, -0.03, 0.02] + 0.02 * rng.standard_normal(force.shape)])


def write_files(folder: Path) -> Path:
    """Write ``odom.txt``, ``kitti.txt``, ``times.txt``, ``imu.csv``, ``gps.csv``, ``wheels.csv``, ``c.yaml``, truth."""
    rng = np.random.default_rng(5)
    times = np.arange(0, SECONDS, 0.1)
    stamps = np.round(times * NS_PER_S).astype(np.int64)
    truth = ride(times) @ T_IMU_LIDAR
    noise = se3.exp(np.r_[np.full(3, 1e-3), np.full(3, 0.01)] * rng.standard_normal((len(times), 6)))
    odometry = [truth[0]]
    for step, off in zip(se3.between(truth[:-1], truth[1:]), noise, strict=False):
        odometry.append(odometry[-1] @ step @ off)
    drifting = Trajectory(stamps, np.array(odometry))
    write_tum(folder / "odom.txt", drifting)
    write_kitti(folder / "kitti.txt", drifting)
    write_tum(folder / "truth.txt", Trajectory(stamps, truth))
    np.savetxt(folder / "times.txt", times, fmt="%.9f")
    imu = imu_rows(np.arange(0, SECONDS, 0.01), rng) + np.r_[IMU_LATE_S, np.zeros(6)]
    _write_csv(folder / "imu.csv", "t_s,gx,gy,gz,ax,ay,az", imu)
    at = np.arange(0.5, SECONDS - 0.5, 0.5)
    antennas = (ride(at) @ np.r_[ANTENNA_M, 1])[:, :3] + 0.02 * rng.standard_normal((len(at), 3))
    _write_csv(folder / "gps.csv", "t_s,east,north,up,sigma", np.column_stack([at, antennas, 0.02 * np.ones(len(at))]))
    h = 1e-3
    forward = se3.between(ride(times - h), ride(times + h))[:, 0, 3] / (2 * h)
    _write_csv(folder / "wheels.csv", "t_s,vx", np.column_stack([times, forward]))
    (folder / "c.yaml").write_text(yaml.safe_dump({"T_imu_lidar": T_IMU_LIDAR.tolist()}))
    return folder


def _write_csv(path: Path, header: str, rows: np.ndarray) -> None:
    np.savetxt(path, rows, fmt="%.9f", delimiter=",", header=header, comments="")
