"""The state after the last scan by the IMU samples since, each of which is integrated once."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import gtsam
import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.core.estimates import State
from hybridlio.core.sensors import NS_PER_S, ImuNoise
from hybridlio.graph.base.preintegration import gtsam_bias, navigation_after, navigation_of, preintegration_params

Values = Sequence[float]


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
        self._turn, self._largest_turn_rad = np.zeros(3), 0.0  # integral of the rates, and the most of its length
        self._nav = navigation_of(state)
        # GTSAM perturbs a NavState's velocity in the body frame; the state's covariance is of the velocity in world
        to_body = np.eye(15)
        to_body[6:9, 6:9] = state.T_world_imu[:3, :3].T
        self._covariance: Array = to_body @ state.covariance @ to_body.T

    def advance(self, stamps_ns: Sequence[int], values: Sequence[Values]) -> None:
        """Integrate samples.

        Args:
            stamps_ns: ascending, the first :attr:`stamp_ns`; at least two.
            values: six for each stamp, angular velocity (rad/s) and specific force (m/s²).
        """
        self._nav, self._covariance = self._after(stamps_ns, values)
        self._turn, self._largest_turn_rad = self._turned(stamps_ns, values)
        self.stamp_ns = stamps_ns[-1]

    def pose_after(self, stamps_ns: Sequence[int], values: Sequence[Values]) -> tuple[Array, Array]:
        """Return the IMU's pose ``(4, 4)`` after samples as for :meth:`advance`, if any, without advancing.

        The covariance ``(6, 6)`` propagates the state's (pose, velocity, biases, gravity) and the samples' noise.
        """
        end_ns, nav, covariance = self.stamp_ns, self._nav, self._covariance
        if stamps_ns:
            end_ns, (nav, covariance) = stamps_ns[-1], self._after(stamps_ns, values)
        pose = nav.pose().matrix()
        # gravity g moves the end by g·dt²/2 in world; a right perturbation's translation is in the frame of the end
        half_dt2 = ((end_ns - self._state.stamp_ns) / NS_PER_S) ** 2 / 2
        by_gravity = half_dt2 * pose[:3, :3].T
        total = covariance[:6, :6].copy()
        total[3:, 3:] += by_gravity @ self._state.gravity_covariance @ by_gravity.T
        return pose, (total + total.T) / 2

    def _after(self, stamps_ns: Sequence[int], values: Sequence[Values]) -> tuple[gtsam.NavState, Array]:
        """Integrate by the trapezoidal rule of :func:`hybridlio.graph.base.preintegration.preintegrate`.

        Sample by sample: for the one or two of a call this takes half the time of arrays.
        """
        steps_s = [(b - a) / NS_PER_S for a, b in pairwise(stamps_ns)]
        pim = gtsam.PreintegratedCombinedMeasurements(self._params_for(max(steps_s)), self._bias)
        samples = [np.array(row) for row in values]
        for step_s, before, after in zip(steps_s, samples, samples[1:], strict=False):
            gyro = (before[:3] + after[:3]) / 2
            turned = gtsam.Rot3.Expmap((gyro - self._state.gyro_bias_rad_s) * step_s).rotate(after[3:])
            pim.integrateMeasurement((before[3:] + turned) / 2, gyro, step_s)
        nav, J = navigation_after(pim, self._nav, self._bias)
        covariance = J @ self._covariance @ J.T + pim.preintMeasCov()
        # of the gyroscope's unknown scale, see with_scale_error: what the largest turn has grown by since
        grown = self._turned(stamps_ns, values)[1] ** 2 - self._largest_turn_rad**2
        covariance[:3, :3] += np.eye(3) * self._noise.gyro_scale_sigma**2 * grown
        return nav, covariance

    def _turned(self, stamps_ns: Sequence[int], values: Sequence[Values]) -> tuple[Array, float]:
        """Return the rates' integral after samples as for :meth:`advance`, and the most that its length has been."""
        turn, largest = self._turn, self._largest_turn_rad
        rates = [np.array(row[:3]) - self._state.gyro_bias_rad_s for row in values]
        for (begin, end), before, after in zip(pairwise(stamps_ns), rates, rates[1:], strict=False):
            turn = turn + (before + after) / 2 * ((end - begin) / NS_PER_S)
            largest = max(largest, float(np.linalg.norm(turn)))
        return turn, largest

    def _params_for(self, longest_s: float) -> gtsam.PreintegrationCombinedParams:
        """Return parameters for the longest step between samples, rounded up to a power of two, to reuse them."""
        gap_s = 2.0 ** math.ceil(math.log2(longest_s))
        if gap_s not in self._params:
            self._params[gap_s] = preintegration_params(self._noise, gap_s, self._state.gravity_m_s2)
        return self._params[gap_s]
