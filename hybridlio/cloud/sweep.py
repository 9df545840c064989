"""How the lidar moved during a sweep, for motion compensation: turned as the gyroscope says, straight at one speed."""

from __future__ import annotations

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.motion_limits import SWEEP_RATE_SIGMA_RAD_S
from hybridlio.core.sensors import NS_PER_S, Calibration, Frame, ImuNoise
from hybridlio.core.trajectory import Trajectory

_FEWEST_SAMPLES = 2


def sweep_motion(sweep: Frame, step: Trajectory, gyro_bias_rad_s: Array, calibration: Calibration) -> Trajectory:
    """Lidar poses around a frame's sweep, in the frame of one of them.

    Args:
        sweep: the frame, with the IMU samples of its sweep, if there are any.
        step: two lidar poses near the sweep, such as :func:`hybridlio.cloud.deskew.constant_twist` of the initial pose; they
            give the speed, and without samples the turn too.
        gyro_bias_rad_s: ``(3,)``, taken off the samples.
        calibration: the extrinsics.

    Returns:
        Poses at the samples' stamps; without samples ``step`` itself, whose motion then goes on.
    """
    imu = sweep.sweep_imu
    if len(imu) < _FEWEST_SAMPLES:
        return step
    R_lidar_imu = calibration.T_imu_lidar[:3, :3].T
    rates = (imu.gyro_rad_s - gyro_bias_rad_s) @ R_lidar_imu.T
    steps_s = np.diff(imu.stamps_ns) / NS_PER_S
    turns = se3.so3_exp((rates[1:] + rates[:-1]) / 2 * steps_s[:, None])
    speed = se3.between(step.poses[0], step.poses[1])[:3, 3] / step.times_s[1]
    R, poses = np.eye(3), [np.eye(4)]
    for turn, step_s in zip(turns, steps_s, strict=True):
        position = poses[-1][:3, 3] + R @ speed * step_s
        R = R @ turn
        poses.append(se3.make(R, position))
    return Trajectory(imu.stamps_ns, np.array(poses))


def compensation_noise(sweep: Frame, noise: ImuNoise) -> Array:
    """``(6, 6)`` by which a step between two compensated scans is less sure than their points say.

    The orientation of a point ``τ`` from the stamp is off by the gyroscope's noise summed over ``τ``, variance
    ``σ_g²·|τ|``; over a sweep of length ``T`` around the stamp a scan as a whole turns by about ``σ_g²·T/12`` of it.
    Without samples it is off by ``τ`` times what the rate differs from the step's, and the scan by ``σ_r²·T²/12``.
    """
    offsets_ns = sweep.scan.time_offsets_ns
    assert offsets_ns is not None
    sweep_s = float(np.ptp(offsets_ns)) / NS_PER_S if len(offsets_ns) else 0.0
    by_gyro = len(sweep.sweep_imu) >= _FEWEST_SAMPLES
    spread = noise.gyro_rad_s_sqrt_hz**2 * sweep_s if by_gyro else (SWEEP_RATE_SIGMA_RAD_S * sweep_s) ** 2
    both_scans = 2 * spread / 12
    return np.diag(np.r_[np.full(3, both_scans), np.zeros(3)])
