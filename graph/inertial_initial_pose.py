"""The initial pose from the IMU: preintegrated samples, or where they are missing the state's velocity carried on."""

from __future__ import annotations

import numpy as np

from hybridlio import se3
from hybridlio.errors import DataError
from hybridlio.estimates import Array, RelativePose, State
from hybridlio.graph.inertial_steps import PREINTEGRATION, InertialSteps
from hybridlio.graph.preintegration import LARGEST_ACCELERATION_M_S2, LARGEST_RATE_RAD_S
from hybridlio.sensors import NS_PER_S, Frame


class Preintegration:
    """Initial pose from the IMU, starting at the graph's velocity, tilt and biases.

    Args:
        steps: sums up the samples; the same as the backend's, so that it is done once.
    """

    name = PREINTEGRATION

    def __init__(self, steps: InertialSteps) -> None:
        self._steps = steps
        self._stamp_ns = 0
        self._turning_rad_s: Array = np.zeros(3)  # of the last step that was estimated, in the IMU's frame

    def predict(self, frame: Frame, state: State) -> RelativePose:
        """Integrate the frame's samples from ``state``.

        Where samples are missing it carries the state's velocity on, and says so in ``ok`` and the covariance.

        Raises:
            DataError: the recording has no IMU samples at all.
        """
        if not state.has_imu:
            raise DataError(
                f"frame {frame.index}: no IMU samples; choose another initial pose, such as constant-velocity, "
                "or a recording with IMU"
            )
        self._stamp_ns = state.stamp_ns
        predicted = self._steps.predicted(frame, state)
        return self._coast(frame, state) if predicted is None else predicted

    def _coast(self, frame: Frame, state: State) -> RelativePose:
        """On at the state's velocity and the last step's turn, as unsure as a vehicle is free to change both."""
        dt_s = (frame.scan.stamp_ns - state.stamp_ns) / NS_PER_S
        R_imu_world = state.T_world_imu[:3, :3].T
        step = se3.exp(np.r_[self._turning_rad_s, R_imu_world @ state.velocity_m_s] * dt_s)
        by_velocity = R_imu_world @ state.covariance[6:9, 6:9] @ R_imu_world.T * dt_s**2
        sigmas = np.r_[np.full(3, LARGEST_RATE_RAD_S * dt_s), np.full(3, LARGEST_ACCELERATION_M_S2 * dt_s**2 / 2)]
        covariance = np.diag(sigmas**2) + np.pad(by_velocity, (3, 0))
        return self._steps.between_lidars(step, covariance, ok=False)

    def correct(self, frame: Frame, estimate: RelativePose) -> None:
        """Remember the turn, for times without samples; all else the graph's state carries."""
        dt_s = (frame.scan.stamp_ns - self._stamp_ns) / NS_PER_S
        self._turning_rad_s = self._steps.T_imu_lidar[:3, :3] @ se3.so3_log(estimate.pose[:3, :3]) / dt_s
