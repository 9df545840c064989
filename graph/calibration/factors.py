"""Factors whose measurements depend on calibration variables.

GTSAM has factors of a lever arm in space, of constant biases and of gravity's direction; clocks, steps of a sensor and
fixes in the plane are factors in Python: 10 to 30 µs to evaluate, 50 to 130 µs to linearise, where GTSAM's own take 1
µs (benchmarks/calibration_factors.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.motion_limits import GRAVITY_M_S2
from hybridlio.graph.calibration.moving_pose import PLANAR, MovingPose, write_jacobians
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.calibrations import CalibrationVariable


@dataclass(frozen=True, eq=False)
class SensorStep:
    """A step that a sensor measures: its pose at the second time in its frame at the first.

    Attributes:
        measured: ``(4, 4)``.
        first, second: poses of the body at both times.
        stated: stated extrinsics ``T_body_sensor`` ``(4, 4)``.
        extrinsics, scale: GTSAM's variables, or None where they are as stated. A step's measured length is its true
            one times the scale.
    """

    measured: Array
    first: MovingPose
    second: MovingPose
    stated: Array
    extrinsics: int | None = None
    scale: int | None = None

    def factor(self, model: Any) -> Any:
        """Return GTSAM's factor."""
        variables = list(dict.fromkeys([*self.first.variables, *self.second.variables, *self._own]))

        def error(this: Any, values: gtsam.Values, jacobians: Any) -> Array:
            del this  # GTSAM's object, which an error's traceback would outlive
            step = self._step(values)
            if jacobians is not None:
                by = self._derivatives(values, step)
                write_jacobians(jacobians, [by[variable] for variable in variables])
            return np.asarray(step.residual[self._rows])

        return gtsam.CustomFactor(model, variables, error)

    @property
    def _own(self) -> list[int]:
        return [variable for variable in (self.extrinsics, self.scale) if variable is not None]

    @property
    def _rows(self) -> Any:
        return PLANAR if self.first.planar else slice(None)

    def _step(self, values: gtsam.Values) -> _Step:
        """Return the residual ``Log(Z⁻¹·D)``, with ``D`` the scaled step, and what its derivatives need."""
        change = np.zeros(6)
        if self.extrinsics is not None:
            change[slice(2, 5) if self.first.planar else slice(0, 6)] = values.atVector(self.extrinsics)
        K = gtsam.Pose3(self.stated).compose(gtsam.Pose3.Expmap(change))
        D = self.first.at(values).compose(K).between(self.second.at(values).compose(K))
        scale = 1.0 if self.scale is None else float(values.atVector(self.scale)[0])
        scaled = gtsam.Pose3(D.rotation(), scale * D.translation())
        return _Step(change, K, D, scale, gtsam.Pose3.Logmap(gtsam.Pose3(self.measured).between(scaled)))

    def _derivatives(self, values: gtsam.Values, step: _Step) -> dict[int, Array]:
        """Return the derivatives of the residual by variable."""
        rows, own = self._rows, slice(2, 5) if self.first.planar else slice(0, 6)
        to_residual = gtsam.Pose3.LogmapDerivative(step.residual)
        by_step = to_residual * np.r_[np.ones(3), np.full(3, step.scale)]
        to_sensor, back = step.K.inverse().AdjointMap(), -step.D.inverse().AdjointMap()
        by: dict[int, Array] = {}
        for pose, of_sensor in ((self.first, by_step @ back), (self.second, by_step)):
            through = (of_sensor @ to_sensor)[rows]
            for variable, part in zip(pose.variables, pose.derivatives(values), strict=True):
                J = through @ part
                by[variable] = by[variable] + J if variable in by else J  # the clock acts on both
        if self.extrinsics is not None:
            by_change = (by_step @ back + by_step) @ gtsam.Pose3.ExpmapDerivative(step.change)
            by[self.extrinsics] = by_change[rows, own]
        if self.scale is not None:
            by[self.scale] = (to_residual[:, 3:] @ step.D.rotation().unrotate(step.D.translation()))[rows, None]
        return by


@dataclass(frozen=True, eq=False)
class _Step:
    """A step at some values: change of the extrinsics, extrinsics, step of the sensor, scale, residual ``(6,)``."""

    change: Array
    K: gtsam.Pose3
    D: gtsam.Pose3
    scale: float
    residual: Array


@dataclass(frozen=True, eq=False)
class AntennaFix:
    """A measured position of an antenna.

    Attributes:
        position: ``(3,)`` in world.
        body: pose of the body at the time of the fix.
        stated: stated antenna in the body frame ``(3,)``.
        lever_arm: GTSAM's variable of it, or None where it is as stated.
    """

    position: Array
    body: MovingPose
    stated: Array
    lever_arm: int | None = None

    def factor(self, model: Any) -> Any:
        """Return GTSAM's own factor where it has one, else a factor in Python."""
        if self.body.planar and self.lever_arm is None and not self.stated.any():
            return gtsam.PoseTranslationPrior2D(self.body.pose, self.position[:2], model)
        if self.body.planar or self.body.clock is not None:
            return self._custom(model)
        if self.lever_arm is not None:
            return gtsam.GPSFactorArmCalib(self.body.pose, self.lever_arm, self.position, model)
        return gtsam.GPSFactorArm(self.body.pose, self.position, self.stated, model)

    def _custom(self, model: Any) -> Any:
        size = 2 if self.body.planar else 3
        variables = [*self.body.variables, *([] if self.lever_arm is None else [self.lever_arm])]

        def error(this: Any, values: gtsam.Values, jacobians: Any) -> Array:
            del this
            arm = self.stated.copy()
            if self.lever_arm is not None:
                arm[:size] = values.atVector(self.lever_arm)
            T = self.body.at(values)
            if jacobians is not None:
                R = T.rotation().matrix()
                by_pose = np.hstack([-R @ se3.hat(arm), R])[:size]
                of_arm = [] if self.lever_arm is None else [R[:size, :size]]
                write_jacobians(jacobians, [*(by_pose @ part for part in self.body.derivatives(values)), *of_arm])
            return np.asarray((T.transformFrom(arm) - self.position)[:size])

        return gtsam.CustomFactor(model, variables, error)


def inertial_factor(
    variables: tuple[int, ...], biases: tuple[int, ...], gravity: int | None, samples: Any
) -> gtsam.NonlinearFactor:
    """Return the factor of preintegrated samples.

    Args:
        variables: first pose and velocity, second pose and velocity.
        biases: two variables where they walk, one where they are constant.
        gravity: variable of its direction, or None where it is along −z.
        samples: preintegrated; without the walk of biases where they are constant.
    """
    made: Any = gtsam
    if gravity is None:
        make = made.CombinedImuFactor if len(biases) == 2 else made.ImuFactor
        return make(*variables, *biases, samples)  # type: ignore[no-any-return]
    make = made.CombinedImuFactorWithGravityDirection if len(biases) == 2 else made.ImuFactorWithGravityDirection
    return make(*variables, *biases, gravity, samples, GRAVITY_M_S2)  # type: ignore[no-any-return]


def extrinsics_matrix(variable: CalibrationVariable | None) -> Array:
    """Return stated extrinsics ``(4, 4)``; the identity where there are none."""
    return np.eye(4) if variable is None else np.asarray(co.to_matrices(variable.stated[None])[0])
