"""How much a platform's motion usually changes from step to step, learned from the steps that scans find."""

from __future__ import annotations

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.motion_limits import ACCELERATION_SIGMA_M_S2, ANGULAR_ACCELERATION_SIGMA_RAD_S2

_MEMORY_STEPS = 20  # 2 s at 10 Hz: a manoeuvre's length, in which a platform shows how it moves
_SIGMAS = 4.0  # of the usual change: the tails of real accelerations are heavier than normal
_PRIOR = np.array([ANGULAR_ACCELERATION_SIGMA_RAD_S2, ACCELERATION_SIGMA_M_S2])


class MotionChange:
    """Judges whether a step continues the motion of the steps before it.

    The change is that of the twist, rotation and translation each for itself. It is compared with its mean square over
    the last steps, and at least with the accelerations of a calm platform.
    """

    def __init__(self) -> None:
        self._twist: Array | None = None
        self._usual_squared = np.zeros(2)  # per axis: (rad/s)², (m/s)²

    def continues(self, pose: Array, dt_s: float) -> bool:
        """Return whether the step ``(4, 4)`` of ``dt_s`` seconds changes the last step's twist no more than usual."""
        if self._twist is None:
            return False
        return bool((self._change(pose, dt_s) <= _SIGMAS**2 * _at_least_calm(self._usual_squared, dt_s)).all())

    def is_abrupt(self, pose: Array, dt_s: float) -> bool:
        """Return whether the step changes the velocity by more than platforms do, whatever was usual so far."""
        if self._twist is None:
            return False
        return bool(self._change(pose, dt_s)[1] > (_SIGMAS * ACCELERATION_SIGMA_M_S2 * dt_s) ** 2)

    def learn(self, pose: Array, dt_s: float, is_typical: bool) -> None:
        """Take the step as the last one; if ``is_typical``, its change too counts as usual."""
        if self._twist is not None and is_typical:
            self._usual_squared += (self._change(pose, dt_s) - self._usual_squared) / _MEMORY_STEPS
        self._twist = se3.log(pose) / dt_s

    def _change(self, pose: Array, dt_s: float) -> Array:
        """Return the mean square change of angular and linear velocity per axis."""
        assert self._twist is not None
        return _mean_square(se3.log(pose) / dt_s - self._twist)


class UsualChange:
    """How much the twist usually changes between two steps.

    Unlike that of :class:`MotionChange`, which judges steps and takes few changes for little, this mean is one of as
    many changes as there were: it predicts the next one.
    """

    def __init__(self) -> None:
        self._twist: Array | None = None
        self._squared, self._changes = np.zeros(2), 0  # per axis: (rad/s)², (m/s)²

    def learn(self, twist: Array | None) -> None:
        """Take the twist ``(6,)`` of the next step; None for a step of which it is not known."""
        if twist is not None and self._twist is not None:
            self._changes = min(self._changes + 1, _MEMORY_STEPS)
            self._squared = self._squared + (_mean_square(twist - self._twist) - self._squared) / self._changes
        self._twist = twist

    def sigmas(self, time_s: float) -> Array:
        """Return standard deviations ``(6,)`` of a change, rad/s and m/s per axis, over a time."""
        return np.repeat(np.sqrt(_at_least_calm(self._squared, time_s)), 3)


def _mean_square(change: Array) -> Array:
    """Return the mean square of angular and linear velocity per axis ``(2,)`` of a change of the twist ``(6,)``."""
    return np.asarray((change**2).reshape(2, 3).mean(axis=1))


def _at_least_calm(squared: Array, time_s: float) -> Array:
    """Return mean squares ``(2,)``, at least those of a calm platform's accelerations over a time."""
    return np.asarray(np.maximum(squared, (_PRIOR * time_s) ** 2))
