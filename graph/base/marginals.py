"""Marginal covariances of a solved run: of its poses, and of the steps between consecutive poses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import GraphError
from hybridlio.core.progress import Progress
from hybridlio.graph.base.isam import gtsam_message

# Variables from which METIS orders the elimination. Its Bayes tree is shallow, so that the joint covariance of two
# poses takes 1.4 ms in a run of any length; COLAMD's takes 0.4 ms in one of 500 scans (1,500 variables), 1.2 in one of
# 4,000, and 40 in one of 50,000.
_LARGE = 12_000

Covariance: TypeAlias = Callable[[Sequence[int]], Array]  # joint marginal covariance of variables


class Marginals:
    """Marginal covariances of a solved graph, from its Bayes tree.

    ``gtsam.Marginals`` gives the same, but always by Cholesky and in COLAMD's order, whose tree is as deep as a chain
    is long.

    Args:
        graph: the factors.
        values: the solution.
        by_qr: whether to eliminate by QR: slower, but Cholesky finds long straight chains indeterminate.

    Raises:
        GraphError: a variable is not determined; the message names it.
    """

    def __init__(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, by_qr: bool = True) -> None:
        is_large, orders = values.size() > _LARGE, gtsam.Ordering
        order = orders.MetisNonlinearFactorGraph if is_large else orders.ColamdNonlinearFactorGraph
        # GTSAM's default is Cholesky; in METIS's order it was 0.4 % wrong in a chain of 20,000 poses with loops
        self._eliminate = (gtsam.EliminateQR,) if by_qr or is_large else ()
        try:
            self._tree = graph.linearize(values).eliminateMultifrontal(order(graph), *self._eliminate)
            self._tree.optimize()  # a system that is not determined fails where it is solved
        except RuntimeError as error:
            reason = "covariances cannot be computed, as the graph does not determine every variable"
            raise GraphError(f"{reason}: {gtsam_message(error)}") from error

    def covariance(self, variables: Sequence[int]) -> Array:
        """Return the joint covariance of some variables, in blocks in their order."""
        if len(variables) == 1:
            factor = self._tree.marginalFactor(variables[0], *self._eliminate)  # owns the numbers of R
            R = np.triu(factor.R())  # below it nothing is set
        else:
            factors, order = self._tree.joint(list(variables), *self._eliminate), gtsam.Ordering()
            for variable in variables:
                order.push_back(variable)
            R = np.asarray(np.linalg.qr(factors.jacobian(order)[0], mode="r"))
        inverse = np.linalg.inv(R)
        return np.asarray(inverse @ inverse.T)


def pose_covariances(marginals: Marginals, poses: Array, progress: Progress) -> tuple[Array, Array]:
    """Return covariances ``(N, 6, 6)`` of the poses ``x`` and ``(N-1, 6, 6)`` of the steps between consecutive poses.

    World is the first pose, so the marginal covariances of poses are relative to it already. A step's covariance needs
    the joint covariance of its two poses, whose errors are mostly common.

    Args:
        marginals: of the solved graph.
        poses: ``(N, 4, 4)`` solved poses.
        progress: called after each pose.
    """
    count = len(poses)
    absolute, steps = np.empty((count, 6, 6)), np.empty((count - 1, 6, 6))
    if count == 1:
        absolute[0] = marginals.covariance([X(0)])
    for k in range(count - 1):
        joint = marginals.covariance([X(k), X(k + 1)])
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
