"""Marginal covariances of a solved run: of its poses, and of the steps between consecutive poses."""

from __future__ import annotations

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import GraphError
from hybridlio.core.progress import Progress
from hybridlio.graph.base.isam import gtsam_message, incremental_solver


def bayes_tree(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.ISAM2:
    """Return the solved graph as an iSAM2, whose Bayes tree gives marginal covariances.

    ``gtsam.Marginals`` would give the same, but it uses Cholesky, which fails on long straight chains.

    Raises:
        GraphError: a variable is not determined; the message names it.
    """
    isam = incremental_solver()
    try:
        isam.update(graph, values)
    except RuntimeError as error:
        raise GraphError(f"smoothing: the graph does not determine every variable: {gtsam_message(error)}") from error
    return isam


def pose_covariances(isam: gtsam.ISAM2, poses: Array, progress: Progress) -> tuple[Array, Array]:
    """Return covariances ``(N, 6, 6)`` of the poses ``x`` and ``(N-1, 6, 6)`` of the steps between consecutive poses.

    World is the first pose, so the marginal covariances of poses are relative to it already. A step's covariance needs
    the joint covariance of its two poses, whose errors are mostly common.

    Args:
        isam: the solved graph.
        poses: ``(N, 4, 4)`` solved poses.
        progress: called after each pose.
    """
    count = len(poses)
    absolute, steps = np.empty((count, 6, 6)), np.empty((count - 1, 6, 6))
    if count == 1:
        absolute[0] = isam.marginalCovariance(X(0))
    for k in range(count - 1):
        joint = isam.jointMarginalCovariance([X(k), X(k + 1)]).fullMatrix()
        absolute[k], absolute[k + 1] = joint[:6, :6], joint[6:, 6:]
        steps[k] = step_covariance(joint, se3.between(poses[k], poses[k + 1]))
        progress("covariances", k + 1, count)
    progress("covariances", count, count)
    return _symmetric(absolute), _symmetric(steps)


def step_covariance(joint: Array, step: Array) -> Array:
    """Return the covariance ``(6, 6)`` of a step ``T_i_j`` from the joint covariance ``(12, 12)`` of poses i and j.

    With right perturbations ``ξ_i`` and ``ξ_j`` the step is perturbed by ``ξ_j − Ad(T_i_j⁻¹) ξ_i``.
    """
    J = np.hstack([-se3.adjoint(se3.inverse(step)), np.eye(6)])
    return np.asarray(J @ joint @ J.T)


def _symmetric(covariances: Array) -> Array:
    return np.asarray((covariances + np.swapaxes(covariances, 1, 2)) / 2)
