"""The simplest initial poses: the last step again, or none. The Kalman filter is in :mod:`hybridlio.sources.kalman`."""

from __future__ import annotations

import numpy as np

from hybridlio.core import se3
from hybridlio.core.estimates import Array, RelativePose, State
from hybridlio.core.sensors import NS_PER_S, Frame

_ACCELERATION_SIGMA_M_S2 = 2.0  # what a road vehicle does between two scans
_ANGULAR_ACCELERATION_SIGMA_RAD_S2 = 0.5
_SPEED_SIGMA_M_S = 20.0
_RATE_SIGMA_RAD_S = 0.3
_FLOOR_SIGMAS = np.r_[np.full(3, 1e-4), np.full(3, 1e-3)]


def unknown_motion_covariance(dt_s: float) -> Array:
    """``(6, 6)`` of a step of ``dt_s`` of which nothing is known but that a vehicle made it."""
    sigmas = np.r_[np.full(3, _RATE_SIGMA_RAD_S), np.full(3, _SPEED_SIGMA_M_S)] * dt_s
    return np.diag(sigmas**2 + _FLOOR_SIGMAS**2)


def changed_motion_covariance(dt_s: float) -> Array:
    """``(6, 6)`` of a step of ``dt_s`` predicted from the step before."""
    sigmas = np.r_[np.full(3, _ANGULAR_ACCELERATION_SIGMA_RAD_S2), np.full(3, _ACCELERATION_SIGMA_M_S2)] * dt_s**2
    return np.diag(sigmas**2 + _FLOOR_SIGMAS**2)


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


class NoResidual:
    """Leaves the initial pose as it is: a run on the initial poses alone, to compare with."""

    name = "none"

    def start(self, frame: Frame) -> None:
        """Nothing to keep."""

    def refine(self, frame: Frame, initial: RelativePose) -> RelativePose:  # noqa: ARG002
        """The initial pose itself."""
        return initial
