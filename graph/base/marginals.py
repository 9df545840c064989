"""How sure a solved run is: marginal covariances of its poses, and of the steps between them."""

from __future__ import annotations

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import GraphError
from hybridlio.core.progress import Progress
from hybridlio.graph.base.isam import incremental_solver, reason


def bayes_tree(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.ISAM2:
    """The solved graph as one that tells marginal covariances; GTSAM's own ``Marginals`` fails on long chains.

    Raises:
        GraphError: a variable is not determined; names it.
    """
    isam = incremental_solver()
    try:
        isam.update(graph, values)
    except RuntimeError as error:
        raise GraphError(f"smoothing: the graph does not fix every variable: {reason(error)}") from error
    return isam


def pose_covariances(isam: gtsam.ISAM2, poses: Array, progress: Progress) -> tuple[Array, Array]:
    """Covariances ``(N, 6, 6)`` of the poses ``x``, and ``(N-1, 6, 6)`` of the steps between consecutive ones.

    World is the first pose, so that the poses' are relative to it without more ado. A step's follow from the joint
    covariance of both its poses: most of what is unsure of them is common to both.

    Args:
        isam: the solved graph.
        poses: ``(N, 4, 4)``, as solved.
        progress: called before each pose.
    """
    count = len(poses)
    absolute, steps = np.empty((count, 6, 6)), np.empty((count - 1, 6, 6))
    if count == 1:
        absolute[0] = isam.marginalCovariance(X(0))
    for k in range(count - 1):
        progress("covariances", k, count)
        joint = isam.jointMarginalCovariance([X(k), X(k + 1)]).fullMatrix()
        absolute[k], absolute[k + 1] = joint[:6, :6], joint[6:, 6:]
        steps[k] = step_covariance(joint, se3.between(poses[k], poses[k + 1]))
    progress("covariances", count - 1, count)
    return _symmetric(absolute), _symmetric(steps)


def step_covariance(joint: Array, step: Array) -> Array:
    """Covariance ``(6, 6)`` of a step ``(4, 4)`` between two poses of joint covariance ``(12, 12)``."""
    J = np.hstack([-se3.adjoint(se3.inverse(step)), np.eye(6)])
    return np.asarray(J @ joint @ J.T)


def _symmetric(covariances: Array) -> Array:
    return np.asarray((covariances + np.swapaxes(covariances, 1, 2)) / 2)
