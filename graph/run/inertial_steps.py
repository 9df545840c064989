"""The samples of a step, summed up once for all that ask: the initial pose, the comparison with it, and the graph."""

from __future__ import annotations

import gtsam

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.estimates import RelativePose, State
from hybridlio.core.sensors import Calibration, Frame, ImuNoise, ImuSamples
from hybridlio.graph.base.preintegration import covers, predict_step, preintegrate

PREINTEGRATION = "preintegration"


class InertialSteps:
    """What the IMU says of the step from a state to a frame; the last answer is kept.

    Args:
        calibration: where the lidar is.
        noise: of the IMU.
    """

    def __init__(self, calibration: Calibration, noise: ImuNoise) -> None:
        self.T_imu_lidar = calibration.T_imu_lidar
        self._noise = noise
        self._asked: tuple[ImuSamples, int, State] | None = None
        self._sum: gtsam.PreintegratedCombinedMeasurements | None = None
        self._predicted: RelativePose | None = None

    def sum(self, frame: Frame, state: State) -> gtsam.PreintegratedCombinedMeasurements | None:
        """The preintegrated samples; None where they do not reach from the state's stamp to the scan's."""
        last = self._asked
        if last is None or last[0] is not frame.imu or last[1] != frame.scan.stamp_ns or last[2] is not state:
            usable = state.has_imu and covers(frame.imu, state.stamp_ns, frame.scan.stamp_ns)
            self._sum = preintegrate(frame.imu, state, self._noise) if usable else None
            self._asked, self._predicted = (frame.imu, frame.scan.stamp_ns, state), None
        return self._sum

    def predicted(self, frame: Frame, state: State) -> RelativePose | None:
        """The step between the lidar's poses; None as of :meth:`sum`."""
        pim = self.sum(frame, state)
        if pim is not None and self._predicted is None:
            step, covariance = predict_step(pim, state)
            self._predicted = self.between_lidars(step, covariance, from_imu=True)
        return self._predicted

    def between_lidars(self, step: Array, covariance: Array, ok: bool = True, from_imu: bool = False) -> RelativePose:
        """A step of the IMU as one of the lidar."""
        T_lidar_imu = se3.inverse(self.T_imu_lidar)
        pose = T_lidar_imu @ step @ self.T_imu_lidar
        covariance = se3.rotate_covariance(covariance, T_lidar_imu)
        return RelativePose(pose, covariance, source=PREINTEGRATION, ok=ok, from_imu=from_imu)
