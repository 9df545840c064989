"""The initial pose from the IMU: preintegrated samples, or constant velocity where samples are missing."""

from __future__ import annotations

import logging

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.estimates import RelativePose, State
from hybridlio.core.motion_limits import LARGEST_ACCELERATION_M_S2, LARGEST_RATE_RAD_S
from hybridlio.core.sensors import NS_PER_S, Frame
from hybridlio.graph.run.inertial_steps import PREINTEGRATION, InertialSteps
from hybridlio.sources.constant_velocity import ConstantVelocity

_log = logging.getLogger(__name__)


class Preintegration:
    """Initial pose from the IMU, starting at the graph's velocity, tilt and biases.

    Args:
        steps: preintegrates the samples; shared with the backend, so that each step is computed once.
    """

    name = PREINTEGRATION

    def __init__(self, steps: InertialSteps) -> None:
        self._steps = steps
        self._stamp_ns = 0
        self._without_imu: ConstantVelocity | None = None
        self._last_rate_rad_s: Array = np.zeros(3)  # of the last estimated step, in the IMU's frame

    def predict(self, frame: Frame, state: State) -> RelativePose:
        """Integrate the frame's samples from ``state``.

        Where samples are missing, continue at the state's velocity, with ``ok`` False and a wider covariance. Before
        the first samples no state has a velocity: continue with the last step.
        """
        self._stamp_ns = state.stamp_ns
        if not state.has_imu:
            if self._without_imu is None:
                _log.warning(
                    "frame %d: no IMU samples so far; until there are, initial poses by constant velocity", frame.index
                )
                self._without_imu = ConstantVelocity()
            return self._without_imu.predict(frame, state)
        self._without_imu = None
        predicted = self._steps.predicted(frame, state)
        if predicted is not None:
            return predicted
        return self._steps.predicted_from_late(frame, state) or self._coast(frame, state)

    def _coast(self, frame: Frame, state: State) -> RelativePose:
        """Continue at the state's velocity and the last step's rate; both may change by the vehicle's limits."""
        dt_s = (frame.scan.stamp_ns - state.stamp_ns) / NS_PER_S
        R_imu_world = state.T_world_imu[:3, :3].T
        step = se3.exp(np.r_[self._last_rate_rad_s, R_imu_world @ state.velocity_m_s] * dt_s)
        by_velocity = R_imu_world @ state.covariance[6:9, 6:9] @ R_imu_world.T * dt_s**2
        sigmas = np.r_[np.full(3, LARGEST_RATE_RAD_S * dt_s), np.full(3, LARGEST_ACCELERATION_M_S2 * dt_s**2 / 2)]
        covariance = np.diag(sigmas**2) + np.pad(by_velocity, (3, 0))
        return self._steps.as_lidar_step(step, covariance, ok=False)

    def correct(self, frame: Frame, estimate: RelativePose) -> None:
        """Remember the rate for steps without samples; the graph's state carries everything else."""
        dt_s = (frame.scan.stamp_ns - self._stamp_ns) / NS_PER_S
        if self._without_imu is not None:
            self._without_imu.correct(frame, estimate)
        self._last_rate_rad_s = self._steps.T_imu_lidar[:3, :3] @ se3.so3_log(estimate.pose[:3, :3]) / dt_s
