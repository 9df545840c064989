"""The Kalman filter (filterpy) as initial-pose source: velocity and angular velocity from past steps and gyroscope."""

from __future__ import annotations

import numpy as np
from filterpy.kalman import KalmanFilter

from hybridlio.core import se3
from hybridlio.core.estimates import RelativePose, State
from hybridlio.core.motion_limits import (
    ACCELERATION_SIGMA_M_S2,
    ANGULAR_ACCELERATION_SIGMA_RAD_S2,
    JERK_SIGMA_M_S3,
    PREDICTION_FLOOR_SIGMAS,
    UNKNOWN_RATE_SIGMA_RAD_S,
    UNKNOWN_SPEED_SIGMA_M_S,
)
from hybridlio.core.sensors import NS_PER_S, Calibration, Frame, ImuNoise

# State vector, lidar frame: velocity, acceleration, angular velocity, gyroscope bias; three components each.
_V, _A, _W, _B = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
_START_SIGMAS = np.r_[
    np.full(3, UNKNOWN_SPEED_SIGMA_M_S), np.full(3, ACCELERATION_SIGMA_M_S2), np.full(3, UNKNOWN_RATE_SIGMA_RAD_S)
]


class Kalman:
    """Predicts by constant acceleration and angular velocity; every step and, before it, the gyroscope correct these.

    Args:
        calibration: the extrinsics.
        noise: the IMU's noise densities.
    """

    name = "kalman"

    def __init__(self, calibration: Calibration, noise: ImuNoise) -> None:
        self._R_lidar_imu = se3.inverse(calibration.T_imu_lidar)[:3, :3]
        self._noise = noise
        self._stamp_ns: int | None = None
        self._filter = KalmanFilter(dim_x=12, dim_z=6)
        self._filter.P = np.diag(np.r_[_START_SIGMAS, np.full(3, noise.gyro_bias_sigma_rad_s)] ** 2)

    def predict(self, frame: Frame, state: State) -> RelativePose:
        """Predict velocities at the frame, correct the angular one by the gyroscope's mean, and return the step."""
        dt_s = (frame.scan.stamp_ns - state.stamp_ns) / NS_PER_S
        self._stamp_ns = state.stamp_ns
        F, Q = np.eye(12), np.zeros((12, 12))
        F[_V, _A] = np.eye(3) * dt_s
        Q[_A, _A] = np.eye(3) * (JERK_SIGMA_M_S3 * dt_s) ** 2
        Q[_W, _W] = np.eye(3) * (ANGULAR_ACCELERATION_SIGMA_RAD_S2 * dt_s) ** 2
        Q[_B, _B] = np.eye(3) * self._noise.gyro_walk_rad_s2_sqrt_hz**2 * dt_s
        self._filter.predict(F=F, Q=Q)
        if len(frame.imu):
            self._correct_by_gyroscope(frame, dt_s)
        return self._step(dt_s, from_imu=len(frame.imu) > 0)

    def correct(self, frame: Frame, estimate: RelativePose) -> None:
        """Correct both velocities by the step."""
        if self._stamp_ns is None:
            return
        dt_s = (frame.scan.stamp_ns - self._stamp_ns) / NS_PER_S
        H = np.zeros((6, 12))
        H[:3, _W] = H[3:, _V] = np.eye(3)
        H[3:, _A] = np.eye(3) * -dt_s / 2  # the mean velocity is the velocity half a step before its end
        self._filter.update(se3.log(estimate.pose)[:, None] / dt_s, R=estimate.covariance / dt_s**2, H=H)

    def _correct_by_gyroscope(self, frame: Frame, dt_s: float) -> None:
        H = np.zeros((3, 12))
        H[:, _W] = H[:, _B] = np.eye(3)
        rate = self._R_lidar_imu @ frame.imu.gyro_rad_s.mean(axis=0)
        by_scale = self._noise.gyro_scale_sigma * float(np.linalg.norm(rate))
        R = np.eye(3) * (self._noise.gyro_rad_s_sqrt_hz**2 / dt_s + by_scale**2)
        self._filter.update(rate[:, None], R=R, H=H)

    def _step(self, dt_s: float, from_imu: bool) -> RelativePose:
        J = np.zeros((6, 12))
        J[:3, _W] = J[3:, _V] = np.eye(3) * dt_s
        J[3:, _A] = np.eye(3) * -(dt_s**2) / 2
        step = (J @ self._filter.x)[:, 0]
        covariance = J @ self._filter.P @ J.T + np.diag(PREDICTION_FLOOR_SIGMAS**2)
        return RelativePose(se3.exp(step), (covariance + covariance.T) / 2, source=self.name, from_imu=from_imu)
