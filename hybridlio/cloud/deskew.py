"""Motion compensation (deskewing): transform every point of a sweep into the lidar frame at the scan's stamp.

The lidar moves during a sweep, so each point is measured in the lidar frame of its own time. Between two known poses
the twist (angular and linear velocity in the body frame) is taken as constant, which is exact on a circular arc at
constant speed. The pose ``s`` seconds into the interval is then ``T·Exp(s·ξ)``, in closed form for all points at once
(Solà, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics", 2018, eq. 172-174).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.core.motion_limits import SWEEP_RATE_SIGMA_RAD_S
from hybridlio.core.sensors import NS_PER_S, Calibration, Frame, ImuNoise, Scan
from hybridlio.core.trajectory import Trajectory

_MIN_IMU_SAMPLES = 2  # one interval to integrate
_MIN_RATE_RAD_S = 1e-9  # avoids 0/0; a sweep at this rate turns by less than rounding errors


def constant_twist(T_start_end: ArrayLike, start_ns: int, end_ns: int) -> Trajectory:
    """Return the motion through one relative pose at constant velocity, for :func:`deskew`.

    Args:
        T_start_end: ``(4, 4)`` lidar pose at ``end_ns`` in the lidar frame at ``start_ns``. With the last step's
            relative pose and the stamps of its scans, the sweep continues that motion.
        start_ns, end_ns: times of the two poses.

    Raises:
        DataError: the times are not ascending, or the pose is not rigid.
    """
    T = se3.check_pose(T_start_end, "constant twist")
    return Trajectory(np.array([start_ns, end_ns]), np.stack([np.eye(4), T]))


def sweep_motion(sweep: Frame, step: Trajectory, gyro_bias_rad_s: Array, calibration: Calibration) -> Trajectory:
    """Return lidar poses around a frame's sweep: rotation from the gyroscope, translation at constant velocity.

    Velocity in the lidar frame is constant, so on a bend the path curves with the rotation.

    Args:
        sweep: the frame, with the IMU samples of its sweep, if there are any.
        step: two lidar poses near the sweep, such as :func:`constant_twist` of the initial pose. They give the
            velocity, and without samples the rotation too.
        gyro_bias_rad_s: ``(3,)``, subtracted from the samples.
        calibration: extrinsics of the IMU.

    Returns:
        Poses at the samples' stamps, in the frame of the first; with fewer than two samples ``step`` itself.
    """
    imu = sweep.sweep_imu
    if len(imu) < _MIN_IMU_SAMPLES:
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


def compensation_noise(sweep: Frame, noise: ImuNoise, change_sigmas: Array | None = None) -> Array:
    """Return the covariance ``(6, 6)``, rad² and m², that compensation adds to a step between two scans.

    With a gyroscope the orientation of a point measured ``τ`` from the stamp has the noise density integrated over
    ``τ``, variance ``σ_g²·|τ|``. Averaged over a sweep of length ``T`` around the stamp, the scan as a whole is rotated
    by a variance of about ``σ_g²·T/12``. Without samples points are wrong by ``τ`` times the difference between
    the actual twist and the mean one of the step, and the scan by a variance of ``σ²`` times the mean of ``τ²``. Both
    scans contribute.

    Args:
        sweep: the frame.
        noise: the gyroscope's.
        change_sigmas: ``(6,)`` standard deviations of that difference without samples, rad/s and m/s; by default those
            of a car whose sweeps follow each other at once.
    """
    offsets_ns = sweep.scan.time_offsets_ns
    assert offsets_ns is not None
    sweep_s = sweep_duration_s(sweep)
    if len(sweep.sweep_imu) >= _MIN_IMU_SAMPLES:
        both_scans = 2 * noise.gyro_rad_s_sqrt_hz**2 * sweep_s / 12
        return np.diag(np.r_[np.full(3, both_scans), np.zeros(3)])
    offsets_s = offsets_ns / NS_PER_S if len(offsets_ns) else np.zeros(1)
    sigmas = np.r_[np.full(3, SWEEP_RATE_SIGMA_RAD_S), np.zeros(3)]
    if change_sigmas is not None:
        sigmas = np.maximum(sigmas, change_sigmas)
    return np.diag(2 * sigmas**2 * np.mean(offsets_s**2))


def sweep_duration_s(frame: Frame) -> float:
    """Return the time from the first to the last point of a frame's scan; 0 where points carry no times."""
    offsets_ns = frame.scan.time_offsets_ns
    return float(np.ptp(offsets_ns)) / NS_PER_S if offsets_ns is not None and len(offsets_ns) else 0.0


def deskew(scan: Scan, motion: Trajectory) -> Scan:
    """Return the scan with all points in the lidar frame at ``scan.stamp_ns``, and without time offsets.

    A scan without time offsets is returned unchanged, as the same object. Times before the first or after the last pose
    are extrapolated with the first or last interval's twist.

    Args:
        scan: each point in the lidar frame of its own time, with ``time_offsets_ns``.
        motion: at least two lidar poses around the sweep (``T_world_imu @ T_imu_lidar`` for poses of an IMU), in any
            world frame: of :func:`sweep_motion` or :func:`constant_twist`.

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
    from hybridlio.cloud.deskew_loop import move_points  # late: compiled

    # times relative to the stamp: a float64 cannot hold nanoseconds since 1970
    knots_s = (motion.stamps_ns - scan.stamp_ns) / NS_PER_S
    twists = se3.log(se3.between(motion.poses[:-1], motion.poses[1:])) / (np.diff(motion.stamps_ns) / NS_PER_S)[:, None]
    T_stamp_world = se3.inverse(_pose_at(0.0, knots_s, motion.poses, twists))
    rates = np.maximum(np.linalg.norm(twists[:, :3], axis=1), _MIN_RATE_RAD_S)
    moving = screws(T_stamp_world @ motion.poses[:-1], twists, rates)
    points, offsets_ns = np.ascontiguousarray(scan.points), np.ascontiguousarray(scan.time_offsets_ns)
    return Scan(scan.stamp_ns, move_points(points, offsets_ns, knots_s, rates, moving), scan.intensity)


def _pose_at(time_s: float, knots_s: Array, poses: Array, twists: Array) -> Array:
    k = int(np.clip(np.searchsorted(knots_s, time_s, side="right") - 1, 0, len(twists) - 1))
    return np.asarray(poses[k] @ se3.exp((time_s - knots_s[k]) * twists[k]))


def screws(T: Array, twists: Array, rates: Array) -> Array:
    """Return what ``T·Exp(s·ξ)·p`` is made of, ``(K, 3, 13)``, for poses, twists and angular rates of ``K`` intervals.

    By Rodrigues' formula for the rotation, and its integral over the angle for the translation, it is
    ``A·(p, 1) + s·d + sin(θ)·B·(p, 1) + (1 − cos(θ))·C·(p, 1)`` with ``θ`` the rate times ``s``. Columns 0 to 3 are A,
    4 to 7 B, 8 to 11 C, and the last is d.
    """
    R, velocity, turn = T[:, :3, :3], twists[:, 3:, None], rates[:, None, None]
    K = se3.hat(twists[:, :3] / rates[:, None])
    KKv = R @ (K @ (K @ velocity)) / turn
    A = [R, T[:, :3, 3:]]
    B, C = [R @ K, -KKv], [R @ K @ K, R @ K @ velocity / turn]
    return np.concatenate([*A, *B, *C, R @ velocity + turn * KKv], axis=2)
