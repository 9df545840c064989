"""How the lidar moved during a sweep, for motion compensation: turned as the gyroscope says, straight at one speed."""

from __future__ import annotations

import numpy as np

from hybridlio import se3
from hybridlio.deskew import constant_twist
from hybridlio.estimates import RelativePose, State
from hybridlio.sensors import NS_PER_S, Calibration, Frame
from hybridlio.trajectory import Trajectory


def sweep_motion(frame: Frame, initial: RelativePose, state: State, calibration: Calibration) -> Trajectory:
    """Lidar poses around the frame's sweep, in the frame of one of them.

    Args:
        frame: with the IMU samples of its sweep, if there are any.
        initial: the step to the frame's stamp; its translation gives the speed, and without samples the turn too.
        state: at the scan before; its gyroscope bias is taken off.
        calibration: the extrinsics.

    Returns:
        Poses at the samples' stamps; without samples the twist of ``initial``, which then goes on.
    """
    stamp_ns, imu = frame.scan.stamp_ns, frame.sweep_imu
    if len(imu) < 2 or not state.has_imu:
        return constant_twist(initial.pose, state.stamp_ns, stamp_ns)
    R_lidar_imu = calibration.T_imu_lidar[:3, :3].T
    rates = (imu.gyro_rad_s - state.gyro_bias_rad_s) @ R_lidar_imu.T
    steps_s = np.diff(imu.stamps_ns) / NS_PER_S
    turns = se3.so3_exp((rates[1:] + rates[:-1]) / 2 * steps_s[:, None])
    speed = initial.pose[:3, 3] * NS_PER_S / (stamp_ns - state.stamp_ns)
    R, poses = np.eye(3), [np.eye(4)]
    for turn, step_s in zip(turns, steps_s, strict=True):
        position = poses[-1][:3, 3] + R @ speed * step_s
        R = R @ turn
        poses.append(se3.make(R, position))
    return Trajectory(imu.stamps_ns, np.array(poses))
