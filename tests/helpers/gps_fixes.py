"""GPS fixes of a simulated drive, whose clock is early."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from online_runs import composed
from scipy.spatial.transform import Rotation

from hybridlio.core import se3
from hybridlio.core.pose_interpolation import PosePath
from hybridlio.core.sensors import Calibration, GpsFix
from hybridlio.core.trajectory import Trajectory
from hybridlio.evaluation.ate_rpe import ate

LEVER = np.array([-0.4, 0.6, 1.1])
SHIFT_S = 0.43
SIGMA_M = 0.3
ENU = se3.make(Rotation.from_euler("ZYX", (2.1, 0.0, 0.0)).as_matrix(), (350.0, -120.0, 4.0))


def T_enu_world(drive: Any) -> np.ndarray:
    """World is the IMU's first pose; rotate it so that gravity points down."""
    down = drive.gravity / np.linalg.norm(drive.gravity)
    axis = np.cross(down, [0.0, 0.0, -1.0])
    angle = np.arccos(np.clip(-down[2], -1, 1))
    level = se3.so3_exp(axis / max(np.linalg.norm(axis), 1e-12) * angle)
    return ENU @ se3.make(level, np.zeros(3))


def with_fixes(drive: Any, seed: int, rate_hz: float = 2.0, sigma_m: float = SIGMA_M, shift_s: float = SHIFT_S) -> Any:
    """The drive's record with fixes of the antenna, whose stamps are ``shift_s`` early."""
    rng = np.random.default_rng(seed)
    record = drive.record(composed(drive))
    stamps = record.online.stamps_ns
    path = PosePath(stamps, drive.poses, drive.velocities)
    seconds = np.arange(0.05, (stamps[-1] - stamps[0]) / 1e9, 1 / rate_hz)
    at = stamps[0] + np.round(seconds * 1e9).astype(np.int64)
    points = se3.transform(T_enu_world(drive), path.points(at, LEVER)[0])
    points = points + sigma_m * rng.standard_normal(points.shape)
    early = at - round(shift_s * 1e9)
    fixes = tuple(GpsFix(int(t), p, np.eye(3) * sigma_m**2) for t, p in zip(early, points, strict=True))
    return replace(record, gps=fixes, calibration=Calibration(record.calibration.T_imu_lidar, antenna_imu_m=LEVER))


def rmse_m(smoothed: Any, drive: Any) -> float:
    """Return the RMS error after alignment of the whole path, so that the first heading does not dominate."""
    return ate(smoothed.trajectory, Trajectory(smoothed.trajectory.stamps_ns, drive.lidar_poses), lever_m=0.0).rmse_m
