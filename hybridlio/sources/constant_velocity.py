"""The simplest initial poses: the last step again, or none. The Kalman filter is in :mod:`hybridlio.sources.kalman`."""

from __future__ import annotations

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.estimates import RelativePose, State
from hybridlio.core.motion_limits import changed_motion_covariance, unknown_motion_covariance
from hybridlio.core.sensors import NS_PER_S, Frame


class Identity:
    """No motion, and not much confidence in that."""

    name = "identity"

    def predict(self, frame: Frame, state: State) -> RelativePose:
        """The identity."""
        dt_s = (frame.scan.stamp_ns - state.stamp_ns) / NS_PER_S
        return RelativePose(np.eye(4), unknown_motion_covariance(dt_s), source=self.name)

    def correct(self, frame: Frame, estimate: RelativePose) -> None:
        """Nothing to learn."""


class ConstantVelocity:
    """The last step's twist, for as long as the new step takes."""

    name = "constant-velocity"

    def __init__(self) -> None:
        self._twist: Array | None = None
        self._stamp_ns = 0

    def predict(self, frame: Frame, state: State) -> RelativePose:
        """The last twist times the time since ``state``; the identity at first."""
        dt_s = (frame.scan.stamp_ns - state.stamp_ns) / NS_PER_S
        self._stamp_ns = state.stamp_ns
        if self._twist is None:
            return RelativePose(np.eye(4), unknown_motion_covariance(dt_s), source=self.name)
        return RelativePose(se3.exp(self._twist * dt_s), changed_motion_covariance(dt_s), source=self.name)

    def correct(self, frame: Frame, estimate: RelativePose) -> None:
        """Remember the step as a twist."""
        self._twist = se3.log(estimate.pose) * NS_PER_S / (frame.scan.stamp_ns - self._stamp_ns)
