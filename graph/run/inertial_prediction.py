"""The state after the last scan by the IMU samples since, each of which is integrated once."""

from __future__ import annotations

import math

import gtsam
import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.core.estimates import State
from hybridlio.core.sensors import NS_PER_S, ImuNoise, ImuSamples
from hybridlio.graph.base.preintegration import gtsam_bias, integrate, preintegration_params


class InertialPrediction:
    """Propagates a state and its covariance by IMU samples.

    Args:
        state: where to start; it has an IMU.
        noise: the IMU's noise densities.
    """

    def __init__(self, state: State, noise: ImuNoise) -> None:
        self.stamp_ns = state.stamp_ns  # of the last sample that was integrated
        self._state, self._noise, self._bias = state, noise, gtsam_bias(state)
        self._params: dict[float, gtsam.PreintegrationCombinedParams] = {}
        self._nav = gtsam.NavState(gtsam.Pose3(state.T_world_imu), state.velocity_m_s)
        # GTSAM perturbs a NavState's velocity in the body frame; the state's covariance is of the velocity in world
        to_body = np.eye(15)
        to_body[6:9, 6:9] = state.T_world_imu[:3, :3].T
        self._covariance: Array = to_body @ state.covariance @ to_body.T

    def advance(self, imu: ImuSamples) -> None:
        """Integrate samples; the first is at :attr:`stamp_ns`. Fewer than two change nothing."""
        if len(imu) >= 2:
            self._nav, self._covariance = self._after(imu)
            self.stamp_ns = int(imu.stamps_ns[-1])

    def pose_after(self, imu: ImuSamples) -> tuple[Array, Array]:
        """Return the IMU's pose ``(4, 4)`` after samples as for :meth:`advance`, without advancing.

        The covariance ``(6, 6)`` propagates the state's (pose, velocity, biases, gravity) and the samples' noise.
        """
        end_ns = int(imu.stamps_ns[-1]) if len(imu) else self.stamp_ns
        nav, covariance = self._after(imu) if len(imu) >= 2 else (self._nav, self._covariance)
        pose = nav.pose().matrix()
        # gravity g moves the end by g·dt²/2 in world; a right perturbation's translation is in the frame of the end
        half_dt2 = ((end_ns - self._state.stamp_ns) / NS_PER_S) ** 2 / 2
        by_gravity = half_dt2 * pose[:3, :3].T
        total = covariance[:6, :6].copy()
        total[3:, 3:] += by_gravity @ self._state.gravity_covariance @ by_gravity.T
        return pose, (total + total.T) / 2

    def _after(self, imu: ImuSamples) -> tuple[gtsam.NavState, Array]:
        pim = gtsam.PreintegratedCombinedMeasurements(self._params_for(imu), self._bias)
        integrate(pim, imu, self._state.gyro_bias_rad_s)
        by_state, by_bias = np.zeros((9, 9), order="F"), np.zeros((9, 6), order="F")
        nav = pim.predict(self._nav, self._bias, by_state, by_bias)
        J = np.eye(15)
        J[:9, :9], J[:9, 9:] = by_state, by_bias
        return nav, J @ self._covariance @ J.T + pim.preintMeasCov()

    def _params_for(self, imu: ImuSamples) -> gtsam.PreintegrationCombinedParams:
        """Return parameters for the longest step between the samples, rounded up to a power of two, to reuse them."""
        longest_s = float(np.diff(imu.stamps_ns).max()) / NS_PER_S
        gap_s = 2.0 ** math.ceil(math.log2(longest_s))
        if gap_s not in self._params:
            self._params[gap_s] = preintegration_params(self._noise, gap_s, self._state.gravity_m_s2)
        return self._params[gap_s]
