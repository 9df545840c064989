"""A pose at a time that differs from its own by a clock's offset, with its derivatives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array

PLANAR = np.array([3, 4, 2])  # x, y, θ, as GTSAM orders them, among our six of a pose in space
_EYE, _ZERO = np.eye(6), np.zeros(3)


@dataclass(frozen=True, eq=False)
class MovingPose:
    """The pose ``X·Exp(δ·w)`` of a body, with the twist ``w`` of its turn rate and ``Rᵀ·v``, at a clock's offset δ.

    Attributes:
        pose: GTSAM's variable ``X``.
        planar: whether it is a ``Pose2``.
        clock: the variable of the offset in s and that of the velocity in world, or None: then δ is zero.
        rate_rad_s: ``(3,)`` turn rate in the body frame.
    """

    pose: int
    planar: bool
    clock: tuple[int, int] | None = None
    rate_rad_s: Array | None = None

    @property
    def variables(self) -> list[int]:
        """GTSAM's variables, the pose first."""
        return [self.pose] if self.clock is None else [self.pose, *self.clock]

    def at(self, values: gtsam.Values) -> gtsam.Pose3:
        """Return the pose."""
        T = self._own(values)
        return T if self.clock is None else T.compose(gtsam.Pose3.Expmap(self._offset(values) * self._twist(values, T)))

    def derivatives(self, values: gtsam.Values) -> list[Array]:
        """Return the derivative ``(6, d)`` of a right perturbation of the pose by each variable."""
        if self.clock is None:
            return [_EYE[:, PLANAR] if self.planar else _EYE]
        T, offset = self._own(values), self._offset(values)
        twist = self._twist(values, T)
        by_twist = offset * gtsam.Pose3.ExpmapDerivative(offset * twist)[:, 3:]
        by_pose = np.array(gtsam.Pose3.Expmap(-offset * twist).AdjointMap())
        by_pose[:, :3] += by_twist @ se3.hat(twist[3:])  # a turn of the body turns Rᵀ·v
        return [by_pose, twist[:, None], by_twist @ T.rotation().matrix().T]

    def _own(self, values: gtsam.Values) -> gtsam.Pose3:
        return gtsam.Pose3(values.atPose2(self.pose)) if self.planar else values.atPose3(self.pose)

    def _offset(self, values: gtsam.Values) -> float:
        assert self.clock is not None
        return float(values.atVector(self.clock[0])[0])

    def _twist(self, values: gtsam.Values, T: gtsam.Pose3) -> Array:
        assert self.clock is not None
        velocity = T.rotation().unrotate(values.atVector(self.clock[1]))
        return np.concatenate([_ZERO if self.rate_rad_s is None else self.rate_rad_s, velocity])


def write_jacobians(jacobians: Any, found: list[Array]) -> None:
    """Give a custom factor's derivatives to GTSAM, whose matrices are stored by columns."""
    for k, J in enumerate(found):
        jacobians[k] = np.asfortranarray(J)
