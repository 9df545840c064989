"""The simplest initial-pose sources: repeat the last step's velocity, or predict no motion."""

from __future__ import annotations

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.estimates import RelativePose, State
from hybridlio.core.motion_limits import PREDICTION_FLOOR_SIGMAS, unknown_motion_covariance
from hybridlio.core.sensors import NS_PER_S, Frame
from hybridlio.sources.gate.motion_change import UsualChange


class Identity:
    """Predicts no motion, with the covariance of an unknown one."""

    name = "identity"

    def predict(self, frame: Frame, state: State) -> RelativePose:
        """Return the identity."""
        dt_s = (frame.scan.stamp_ns - state.stamp_ns) / NS_PER_S
        return RelativePose(np.eye(4), unknown_motion_covariance(dt_s), source=self.name)

    def correct(self, frame: Frame, estimate: RelativePose) -> None:
        """Do nothing: there is no state to correct."""


class ConstantVelocity:
    """Predicts that the twist of the last step continues."""

    name = "constant-velocity"

    def __init__(self) -> None:
        self._twist: Array | None = None
        self._stamp_ns = self._found_ns = 0  # of the scan before, and of the last one whose step was found
        self._change = UsualChange()

    def predict(self, frame: Frame, state: State) -> RelativePose:
        """Return the last twist times the time since ``state``; the identity before the first step.

        The twist is the less certain the older it is, and the more it has changed from step to step so far.
        """
        dt_s = (frame.scan.stamp_ns - state.stamp_ns) / NS_PER_S
        self._stamp_ns = state.stamp_ns
        if self._twist is None:
            return RelativePose(np.eye(4), unknown_motion_covariance(dt_s), source=self.name)
        sigmas = self._change.sigmas((frame.scan.stamp_ns - self._found_ns) / NS_PER_S) * dt_s
        covariance = np.diag(sigmas**2 + PREDICTION_FLOOR_SIGMAS**2)
        return RelativePose(se3.exp(self._twist * dt_s), covariance, source=self.name)

    def correct(self, frame: Frame, estimate: RelativePose) -> None:
        """Take the twist from the step to ``frame``."""
        follows = self._found_ns == self._stamp_ns
        self._twist = se3.log(estimate.pose) * NS_PER_S / (frame.scan.stamp_ns - self._stamp_ns)
        self._found_ns = frame.scan.stamp_ns
        if not follows:  # after scans that were not found
            self._change.learn(None)
        self._change.learn(self._twist)
