"""The state at the first scan: tilt from the accelerometer, speed and biases unknown.

The vehicle need not stand still. The specific force averaged over the first samples points up, apart from the
vehicle's own acceleration. Wide priors on gravity and speed go into the graph, where the first relative poses narrow
them.
"""

from __future__ import annotations

import numpy as np

from hybridlio.core.errors import DataError
from hybridlio.core.estimates import State
from hybridlio.core.motion_limits import GRAVITY_M_S2, MEAN_ACCELERATION_SIGMA_M_S2, UNKNOWN_SPEED_SIGMA_M_S
from hybridlio.core.sensors import ImuNoise, ImuSamples

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
    mean_force = imu.accel_m_s2.mean(axis=0)
    magnitude = float(np.linalg.norm(mean_force))
    if magnitude < _MIN_FORCE_M_S2:
        raise DataError(
            f"the specific force of the first {len(imu)} IMU samples averages to {magnitude:.2g} m/s²; at rest it "
            "is 9.81. Leave the IMU out if it has no accelerometer"
        )
    gravity = -GRAVITY_M_S2 * mean_force / magnitude
    standard_error = imu.accel_m_s2.std(axis=0).max() / np.sqrt(len(imu))
    gravity_covariance = np.eye(3) * (MEAN_ACCELERATION_SIGMA_M_S2**2 + standard_error**2)
    return State(stamp_ns, np.eye(4), zero, zero, zero, gravity, covariance, gravity_covariance)
