"""Start-up: what can be said of tilt, speed and biases before the first step, and how little that is.

Nothing is assumed at rest: the specific force averaged over the first samples points up but for the vehicle's own
acceleration, and the speed is unknown. Both go into the graph as wide priors, which the first relative poses narrow.
"""

from __future__ import annotations

import numpy as np

from hybridlio.core.errors import DataError
from hybridlio.core.estimates import State
from hybridlio.core.motion_limits import GRAVITY_M_S2, MEAN_ACCELERATION_SIGMA_M_S2, UNKNOWN_SPEED_SIGMA_M_S
from hybridlio.core.sensors import ImuNoise, ImuSamples

_LEAST_FORCE_M_S2 = 1e-3  # less than any accelerometer's own error: there is none


def start_state(stamp_ns: int, imu: ImuSamples, noise: ImuNoise) -> State:
    """The first scan's state from the samples around it; without samples, one that has no IMU.

    Args:
        stamp_ns: the first scan's stamp.
        imu: samples before or just after it, in the IMU frame (which is world's, at this stamp).
        noise: how far the biases may be from zero.

    Raises:
        DataError: the specific force is zero, and does not say where down is.

    Returns:
        The state, at the origin, with speed and biases zero and gravity opposite to the mean specific force, as unsure
        every way as the vehicle's own acceleration; that its magnitude is known is for the graph to add.
    """
    speed = np.full(3, UNKNOWN_SPEED_SIGMA_M_S)
    biases = np.r_[np.full(3, noise.accel_bias_sigma_m_s2), np.full(3, noise.gyro_bias_sigma_rad_s)]
    covariance = np.diag(np.r_[np.full(6, 1e-6), speed, biases] ** 2)
    zero = np.zeros(3)
    if not len(imu):
        down = np.array([0.0, 0.0, -GRAVITY_M_S2])
        return State(stamp_ns, np.eye(4), zero, zero, zero, down, covariance, np.eye(3), has_imu=False)
    mean_force = imu.accel_m_s2.mean(axis=0)
    magnitude = float(np.linalg.norm(mean_force))
    if magnitude < _LEAST_FORCE_M_S2:
        raise DataError(
            f"the specific force of the first {len(imu)} IMU samples averages to {magnitude:.2g} m/s²; at rest it "
            "would be 9.81: leave out an IMU that has no accelerometer"
        )
    gravity = -GRAVITY_M_S2 * mean_force / magnitude
    standard_error = imu.accel_m_s2.std(axis=0).max() / np.sqrt(len(imu))
    gravity_covariance = np.eye(3) * (MEAN_ACCELERATION_SIGMA_M_S2**2 + standard_error**2)
    return State(stamp_ns, np.eye(4), zero, zero, zero, gravity, covariance, gravity_covariance)
