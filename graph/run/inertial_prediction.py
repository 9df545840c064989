"""The state after the last scan by the IMU samples since, each of which is integrated once."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import gtsam
import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.core.estimates import State
from hybridlio.core.sensors import NS_PER_S, ImuNoise
from hybridlio.graph.base.preintegration import gtsam_bias, navigation_after, navigation_of, preintegration_params

Values = Sequence[float]


class _Propagated(NamedTuple):
    """The state after some samples.

    Attributes:
        nav: pose and velocity.
        covariance: ``(15, 15)``, as GTSAM perturbs a NavState, and of the biases.
        turn: ``(3,)`` the rates' integral, rad.
        largest_turn_rad: the most that its length has been.
    """

    nav: gtsam.NavState
    covariance: Array
    turn: Array
    largest_turn_rad: float


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
        # GTSAM perturbs a NavState's velocity in the body frame; the state's covariance is of the velocity in world
        to_body = np.eye(15)
        to_body[6:9, 6:9] = state.T_world_imu[:3, :3].T
        self._now = _Propagated(navigation_of(state), to_body @ state.covariance @ to_body.T, np.zeros(3), 0.0)

    def advance(self, stamps_ns: Sequence[int], values: Sequence[Values]) -> None:
        """Integrate samples.

        Args:
            stamps_ns: ascending, the first :attr:`stamp_ns`; at least two.
            values: six for each stamp, angular velocity (rad/s) and specific force (m/s²).
        """
        self._now = self._after(stamps_ns, values)
        self.stamp_ns = stamps_ns[-1]

    def pose_after(self, stamps_ns: Sequence[int], values: Sequence[Values]) -> tuple[Array, Array]:
        """Return the IMU's pose ``(4, 4)`` after samples as for :meth:`advance`, if any, without advancing.

        The covariance ``(6, 6)`` propagates the state's (pose, velocity, biases, gravity) and the samples' noise.
        """
        end_ns, then = (stamps_ns[-1], self._after(stamps_ns, values)) if stamps_ns else (self.stamp_ns, self._now)
        pose = then.nav.pose().matrix()
        # gravity g moves the end by g·dt²/2 in world; a right perturbation's translation is in the frame of the end
        half_dt2 = ((end_ns - self._state.stamp_ns) / NS_PER_S) ** 2 / 2
        by_gravity = half_dt2 * pose[:3, :3].T
        total = then.covariance[:6, :6].copy()
        total[3:, 3:] += by_gravity @ self._state.gravity_covariance @ by_gravity.T
        return pose, (total + total.T) / 2

    def _after(self, stamps_ns: Sequence[int], values: Sequence[Values]) -> _Propagated:
        """Integrate by the trapezoidal rule of :func:`hybridlio.graph.base.preintegration.preintegrate`.

        Sample by sample: for the one or two of a call this takes half the time of arrays.
        """
        steps_s = [(b - a) / NS_PER_S for a, b in pairwise(stamps_ns)]
        pim = gtsam.PreintegratedCombinedMeasurements(self._params_for(max(steps_s)), self._bias)
        samples = [np.array(row) for row in values]
        turn, largest = self._now.turn, self._now.largest_turn_rad
        for step_s, before, after in zip(steps_s, samples, samples[1:], strict=False):
            gyro = (before[:3] + after[:3]) / 2
            by_step = (gyro - self._state.gyro_bias_rad_s) * step_s
            turn = turn + by_step
            largest = max(largest, float(np.linalg.norm(turn)))
            turned = gtsam.Rot3.Expmap(by_step).rotate(after[3:])
            pim.integrateMeasurement((before[3:] + turned) / 2, gyro, step_s)
        nav, J = navigation_after(pim, self._now.nav, self._bias)
        covariance = J @ self._now.covariance @ J.T + pim.preintMeasCov()
        # of the gyroscope's unknown scale, see with_scale_error: what the largest turn has grown by since
        grown = largest**2 - self._now.largest_turn_rad**2
        covariance[:3, :3] += np.eye(3) * self._noise.gyro_scale_sigma**2 * grown
        return _Propagated(nav, covariance, turn, largest)

    def _params_for(self, longest_s: float) -> gtsam.PreintegrationCombinedParams:
        """Return parameters for the longest step between samples, rounded up to a power of two, to reuse them."""
        gap_s = 2.0 ** math.ceil(math.log2(longest_s))
        if gap_s not in self._params:
            self._params[gap_s] = preintegration_params(self._noise, gap_s, self._state.gravity_m_s2)
        return self._params[gap_s]
