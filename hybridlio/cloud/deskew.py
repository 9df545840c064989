"""Motion compensation: the points of a sweep moved to where they would have been seen at the scan's stamp.

While a lidar turns it moves, so each point is measured in a lidar frame of its own time. Between two known poses the
motion is taken as a constant twist (constant angular and linear velocity in the body), which is exact for a turn at
constant speed; a point at ``s`` seconds into the step then moves by ``Exp(s·ξ)``, in closed form for all points at once
(Solà, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics", 2018, eq. 172-174).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.core.motion_limits import SWEEP_RATE_SIGMA_RAD_S
from hybridlio.core.sensors import NS_PER_S, Calibration, Frame, ImuNoise, Scan
from hybridlio.core.trajectory import Trajectory

_FEWEST_SAMPLES = 2  # one step between IMU samples
_PIECE = 16384  # points at a time, so that the temporaries stay in the processor's cache


def constant_twist(T_start_end: ArrayLike, start_ns: int, end_ns: int) -> Trajectory:
    """The motion that goes through one relative pose at constant velocity; what :func:`deskew` takes.

    Args:
        T_start_end: ``(4, 4)`` lidar pose at ``end_ns`` in the lidar frame at ``start_ns``, such as the last scan's
            relative pose with the stamps of the two scans: the sweep then continues that motion.
        start_ns, end_ns: the two times.

    Raises:
        DataError: no time passes between the two, or the pose is not rigid.
    """
    T = se3.check_pose(T_start_end, "constant twist")
    return Trajectory(np.array([start_ns, end_ns]), np.stack([np.eye(4), T]))


def sweep_motion(sweep: Frame, step: Trajectory, gyro_bias_rad_s: Array, calibration: Calibration) -> Trajectory:
    """Lidar poses around a frame's sweep, in the frame of one of them.

    Args:
        sweep: the frame, with the IMU samples of its sweep, if there are any.
        step: two lidar poses near the sweep, such as :func:`constant_twist` of the initial pose; they give
            the speed, and without samples the turn too.
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


def deskew(scan: Scan, motion: Trajectory) -> Scan:
    """The scan as if all its points had been measured at ``scan.stamp_ns``; its time offsets are None afterwards.

    A scan without time offsets needs no compensation and is returned itself, the same object. Points before the first
    or after the last pose, and the stamp where it lies there, continue at the first or last step's velocity.

    Args:
        scan: points each in the lidar frame of its own time, with ``time_offsets_ns``.
        motion: two or more lidar poses (``T_world_imu @ T_imu_lidar`` for those of an IMU) around the sweep, in any
            world frame: poses at IMU stamps, or :func:`constant_twist`.

    Raises:
        DataError: the motion has fewer than two poses.
    """
    if scan.time_offsets_ns is None:
        return scan
    if len(motion) < 2:
        raise DataError(
            f"scan at {scan.stamp_ns} ns: motion compensation needs at least two poses around the sweep, "
            f"got {len(motion)}; give IMU poses or a constant twist"
        )
    # relative to the stamp: nanoseconds since 1970 do not fit a float64
    knots_s = (motion.stamps_ns - scan.stamp_ns) / NS_PER_S
    twists = se3.log(se3.between(motion.poses[:-1], motion.poses[1:])) / (np.diff(motion.stamps_ns) / NS_PER_S)[:, None]
    T_stamp_world = se3.inverse(_pose_at(0.0, knots_s, motion.poses, twists))
    times_s = scan.time_offsets_ns / NS_PER_S
    step = np.clip(np.searchsorted(knots_s, times_s, side="right") - 1, 0, len(twists) - 1)
    columns, points = np.ascontiguousarray(scan.points.T), np.empty_like(scan.points)
    for k in np.flatnonzero(np.bincount(step, minlength=len(twists))):
        of_step = np.flatnonzero(step == k)
        for start in range(0, len(of_step), _PIECE):
            own = of_step[start : start + _PIECE]
            seconds = times_s[own] - knots_s[k]
            points[own] = _screw(T_stamp_world @ motion.poses[k], twists[k], seconds, columns[:, own]).T
    return Scan(scan.stamp_ns, points, scan.intensity)


def _pose_at(time_s: float, knots_s: Array, poses: Array, twists: Array) -> Array:
    k = int(np.clip(np.searchsorted(knots_s, time_s, side="right") - 1, 0, len(twists) - 1))
    return np.asarray(poses[k] @ se3.exp((time_s - knots_s[k]) * twists[k]))


def _screw(T: Array, twist: Array, seconds: Array, points: NDArray[np.float32]) -> Array:
    """``T·Exp(s_i·ξ) p_i``, ``(3, N)``, of points ``(3, N)`` and seconds ``(N,)``, for one pose and one twist."""
    R, velocity = T[:3, :3], twist[3:]
    rate = max(float(np.linalg.norm(twist[:3])), 1e-9)  # a slower turn is below any rounding over a sweep
    K = se3.hat(twist[:3] / rate)
    p = points.astype(np.float64)
    angle = rate * seconds
    sine, versine = np.sin(angle), 1 - np.cos(angle)
    # Rodrigues' formula for the rotation, its integral over the angle for the translation
    KKv = R @ (K @ (K @ velocity)) / rate
    moved = R @ p + T[:3, 3:] + np.outer(R @ velocity, seconds)
    moved += sine * ((R @ K) @ p - KKv[:, None])
    moved += versine * ((R @ K @ K) @ p + (R @ K @ velocity / rate)[:, None])
    moved += np.outer(KKv, angle)
    return np.asarray(moved)
