"""Factors whose residual is computed in Python, as GTSAM's ``CustomFactor``."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.marginals import Marginal
from hybridlio.graph.model.user_residual import UserResidual

_PLANAR = np.array(co.GTSAM_ORDER[2])  # GTSAM's x, y, θ among our heading, x, y


class _PythonFactor(gtsam.CustomFactor):
    """GTSAM's factor of a residual in Python, which it keeps: GTSAM cannot copy such a factor."""

    def __init__(self, model: Any, variables: list[int], residual: Any) -> None:
        super().__init__(model, variables, residual)
        self.residual = residual


def with_model(factor: Any, model: Any) -> Any:
    """Return a copy of a factor with another noise model.

    Raises:
        RuntimeError: GTSAM cannot copy the factor, as a user's own ``CustomFactor``.
    """
    if isinstance(factor, _PythonFactor):
        return _PythonFactor(model, list(factor.keys()), factor.residual)
    return factor.cloneWithNewNoiseModel(model)


def custom_factor(residual: UserResidual, variables: list[int], model: Any) -> Any:
    """Return a residual of poses as GTSAM's factor."""
    planar = residual.dimension == 2

    def error(this: Any, values: gtsam.Values, jacobians: Any) -> Array:
        del this  # GTSAM's object, which an error's traceback would outlive
        poses = [_matrix(values, key, planar) for key in variables]
        if jacobians is not None:
            for k, J in enumerate(residual.derivatives(poses)):
                jacobians[k] = np.asfortranarray(J[:, _PLANAR] if planar else J)
        return residual(poses)

    return _PythonFactor(model, variables, error)


def _matrix(values: gtsam.Values, key: int, planar: bool) -> Array:
    if not planar:
        return np.asarray(values.atPose3(key).matrix())
    pose = values.atPose2(key)
    return np.asarray(co.to_matrices(np.array([[pose.x(), pose.y(), pose.theta()]]))[0])


def body_velocity_factor(measured: Array, pose: int, velocity: int, model: Any) -> Any:
    """Return a measurement of the velocity ``(3,)`` in the frame of the body: ``Rᵀ v``."""

    def error(this: Any, values: gtsam.Values, jacobians: Any) -> Array:
        del this
        R = values.atPose3(pose).rotation().matrix()
        in_body = R.T @ values.atVector(velocity)
        if jacobians is not None:
            jacobians[0] = np.asfortranarray(np.hstack([se3.hat(in_body), np.zeros((3, 3))]))
            jacobians[1] = np.asfortranarray(R.T)
        return np.asarray(in_body - measured)

    return _PythonFactor(model, [pose, velocity], error)


def linear_factor(marginal: Marginal, variables: list[int]) -> Any:
    """Return the factor of a marginal over pose variables.

    In Python, because GTSAM's own linear factors can be made of at most three variables from there.
    """
    at, blocks = co.gtsam_poses(marginal.coordinates), np.split(marginal.A, len(variables), axis=1)
    kind = "atPose2" if marginal.coordinates.shape[1] == 3 else "atPose3"

    def error(this: Any, values: gtsam.Values, jacobians: Any) -> Array:
        del this
        now = [getattr(values, kind)(variable) for variable in variables]
        moved = np.concatenate([before.localCoordinates(pose) for before, pose in zip(at, now, strict=True)])
        if jacobians is not None:
            for k, block in enumerate(blocks):
                jacobians[k] = np.asfortranarray(block)
        return np.asarray(marginal.A @ moved - marginal.b)

    return _PythonFactor(gtsam.noiseModel.Unit.Create(len(marginal.b)), variables, error)
