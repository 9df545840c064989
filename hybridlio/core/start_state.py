"""The state at the first scan: tilt from the accelerometer, speed and biases unknown; and how its rates change.

The vehicle need not stand still. The specific force averaged over the first samples points up, apart from the
vehicle's own acceleration. Wide priors on gravity and speed go into the graph, where the first relative poses narrow
them.
"""

from __future__ import annotations

import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.core.estimates import State
from hybridlio.core.motion_limits import (
    GRAVITY_M_S2,
    MEAN_ACCELERATION_SIGMA_M_S2,
    UNKNOWN_RATE_SIGMA_RAD_S,
    UNKNOWN_SPEED_SIGMA_M_S,
)
from hybridlio.core.sensors import NS_PER_S, ImuNoise, ImuSamples

_MIN_FORCE_M_S2 = 1e-3  # below any accelerometer's error: such data are placeholders
_ORIGIN_SIGMAS = np.full(6, 1e-6)  # the pose defines the origin; GTSAM needs a positive definite prior


def start_state(stamp_ns: int, imu: ImuSamples, noise: ImuNoise) -> State:
    """Return the state at the first scan, from the IMU samples around it.

    Args:
        stamp_ns: stamp of the first scan.
        imu: samples before or just after it, in the IMU frame. World is that frame at this stamp.
        noise: standard deviations of the biases.

    Returns:
        The state at the origin, with velocity and biases zero. Gravity is opposite to the mean specific force, with
        the uncertainty of the vehicle's own acceleration in every direction; the graph adds that its magnitude is
        known. Without samples the state has no IMU.

    Raises:
        DataError: the mean specific force is zero, so that the vertical is undefined.
    """
    velocity = np.full(3, UNKNOWN_SPEED_SIGMA_M_S)
    biases = np.r_[np.full(3, noise.accel_bias_sigma_m_s2), np.full(3, noise.gyro_bias_sigma_rad_s)]
    covariance = np.diag(np.r_[_ORIGIN_SIGMAS, velocity, biases] ** 2)
    zero = np.zeros(3)
    if not len(imu):
        down = np.array([0.0, 0.0, -GRAVITY_M_S2])
        return State(stamp_ns, np.eye(4), zero, zero, zero, down, covariance, np.eye(3), has_imu=False)
    force = _force_at(stamp_ns, imu)
    mean_force = force.mean(axis=0)
    magnitude = float(np.linalg.norm(mean_force))
    if magnitude < _MIN_FORCE_M_S2:
        raise DataError(
            f"the specific force of the first {len(imu)} IMU samples averages to {magnitude:.2g} m/s²; at rest it "
            "is 9.81. Leave the IMU out if it has no accelerometer"
        )
    gravity = -GRAVITY_M_S2 * mean_force / magnitude
    standard_error = force.std(axis=0).max() / np.sqrt(len(imu))
    gravity_covariance = np.eye(3) * (MEAN_ACCELERATION_SIGMA_M_S2**2 + standard_error**2)
    return State(stamp_ns, np.eye(4), zero, zero, zero, gravity, covariance, gravity_covariance)


def _force_at(stamp_ns: int, imu: ImuSamples) -> Array:
    """Return the specific forces ``(S, 3)`` in the IMU's frame at the sample nearest to a stamp.

    A drone turns by half a radian between two scans; its samples, averaged as they are, tilt the vertical by as much.
    """
    R = imu.orientations(np.zeros(3))
    nearest = int(np.abs(imu.stamps_ns - stamp_ns).argmin())
    return np.asarray((R[nearest].T @ R @ imu.accel_m_s2[..., None])[..., 0])


def rate_change(imu: ImuSamples, time_s: float) -> float:
    """Return by how much an axis' rate changes over a time, rad/s: the root mean square in some samples.

    Where they are shorter, the change grows in proportion to the time.
    """
    steps = np.diff(imu.stamps_ns) / NS_PER_S
    if not len(steps):
        return UNKNOWN_RATE_SIGMA_RAD_S
    lag = int(np.clip(round(time_s / float(steps.mean())), 1, max(len(steps) // 2, 1)))
    change = imu.gyro_rad_s[lag:] - imu.gyro_rad_s[:-lag]
    return float(np.sqrt(np.mean(change**2)) * max(time_s / (lag * steps.mean()), 1.0))


def turn_beyond_linear_rates(imu: ImuSamples, time_s: float) -> float:
    """Return how far an axis turns away from a motion whose rate changes linearly over a time, rad.

    The root mean square at both ends of the time, of all such times in some samples, or of all samples if they are
    shorter. Motors and steps make a platform turn to and fro several times a second.
    """
    if len(imu) < 4:
        return 0.0
    turned = np.vstack([np.zeros(3), np.cumsum(imu.turns(np.zeros(3)), axis=0)])
    count = int(np.clip(round(time_s * NS_PER_S / np.diff(imu.stamps_ns).mean()) + 1, 4, len(imu)))
    powers = np.linspace(0.0, 1.0, count)[:, None] ** [0, 1, 2]
    beside = np.eye(count) - powers @ np.linalg.pinv(powers)
    windows = np.lib.stride_tricks.sliding_window_view(turned, count, axis=0)  # (W, 3, count)
    return float(np.sqrt(np.mean((windows @ beside)[..., [0, -1]] ** 2)))
