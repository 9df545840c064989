"""The IMU's share of a step, computed once for the initial pose, the innovation gate and the graph."""

from __future__ import annotations

import gtsam
import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.estimates import RelativePose, State
from hybridlio.core.motion_limits import LARGEST_ACCELERATION_M_S2
from hybridlio.core.sensors import NS_PER_S, Calibration, Frame, ImuNoise, ImuSamples
from hybridlio.core.start_state import rate_change
from hybridlio.graph.base.preintegration import (
    covers,
    makes_one_factor,
    predict_in_parts,
    predict_step,
    preintegrate,
)

PREINTEGRATION = "preintegration"


class InertialSteps:
    """Preintegrated samples of the step from a state to a frame; the last result is kept.

    Args:
        calibration: its ``T_imu_lidar`` is used.
        noise: of the IMU; may be changed from step to step.
    """

    def __init__(self, calibration: Calibration, noise: ImuNoise) -> None:
        self.T_imu_lidar = calibration.T_imu_lidar
        self.noise = noise
        self._inputs: tuple[object, ...] | None = None
        self._preintegrated: gtsam.PreintegratedCombinedMeasurements | None = None
        self._covers = False
        self._predicted: RelativePose | None = None

    def preintegrated(self, frame: Frame, state: State) -> gtsam.PreintegratedCombinedMeasurements | None:
        """Return the preintegrated samples as one factor takes them.

        None where they do not cover the step from ``state`` to the scan, or turn by more than one factor can describe:
        half a turn while no scan came.
        """
        self._look(frame, state)
        return self._preintegrated

    def predicted(self, frame: Frame, state: State) -> RelativePose | None:
        """Return the step between the lidar's poses, or None where the samples do not cover it."""
        self._look(frame, state)
        if self._covers and self._predicted is None:
            pim = self._preintegrated
            step = predict_in_parts(frame.imu, state, self.noise) if pim is None else predict_step(pim, state)
            self._predicted = self.as_lidar_step(*step, from_imu=True)
        return self._predicted

    def predicted_from_late(self, frame: Frame, state: State) -> RelativePose | None:
        """Return the step by samples that start after the state, the first held back to it; None if there are none.

        It is no measurement, so ``ok`` is False. The rate while there were no samples may have changed as it does after
        them.
        """
        samples = ImuSamples.concatenate([frame.imu, frame.sweep_imu])
        late_s = float(samples.stamps_ns[0] - state.stamp_ns) / NS_PER_S if len(samples) else 0.0
        held = samples.held_from(state.stamp_ns)
        if not state.has_imu or held is samples:
            return None
        step, covariance = predict_in_parts(held.between(state.stamp_ns, frame.scan.stamp_ns), state, self.noise)
        sigmas = np.r_[
            np.full(3, rate_change(samples, late_s) * late_s), np.full(3, LARGEST_ACCELERATION_M_S2 * late_s**2)
        ]
        return self.as_lidar_step(step, covariance + np.diag((sigmas / 2) ** 2), ok=False)

    def _look(self, frame: Frame, state: State) -> None:
        """Preintegrate, unless the last call had the same inputs."""
        inputs = (self.noise, *_inputs(frame, state))
        if inputs == self._inputs:
            return
        self._covers = state.has_imu and covers(frame.imu, state.stamp_ns, frame.scan.stamp_ns)
        is_factor = self._covers and makes_one_factor(frame.imu, state)
        self._preintegrated = preintegrate(frame.imu, state, self.noise) if is_factor else None
        self._inputs, self._predicted = inputs, None

    def as_lidar_step(self, step: Array, covariance: Array, ok: bool = True, from_imu: bool = False) -> RelativePose:
        """Convert a step of the IMU ``(4, 4)`` with its covariance ``(6, 6)`` to one of the lidar."""
        T_lidar_imu = se3.inverse(self.T_imu_lidar)
        pose = T_lidar_imu @ step @ self.T_imu_lidar
        covariance = se3.rotate_covariance(covariance, T_lidar_imu)
        return RelativePose(pose, covariance, source=PREINTEGRATION, ok=ok, from_imu=from_imu)


def _inputs(frame: Frame, state: State) -> tuple[object, ...]:
    """Everything that the result depends on, by value: a few kilobytes, compared in microseconds."""
    imu = frame.imu
    arrays = (
        imu.stamps_ns, imu.gyro_rad_s, imu.accel_m_s2,
        state.T_world_imu, state.velocity_m_s, state.accel_bias_m_s2, state.gyro_bias_rad_s, state.gravity_m_s2,
        state.covariance, state.gravity_covariance,
    )  # fmt: skip
    return (frame.scan.stamp_ns, state.stamp_ns, state.has_imu, *(array.tobytes() for array in arrays))
