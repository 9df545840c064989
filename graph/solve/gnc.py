"""Rejection of wrong loop closures by graduated non-convexity with truncated least squares.

Yang, Antonante, Tzoumas, Carlone, "Graduated non-convexity for robust spatial perception" (RA-L 2020), section IV.
GTSAM's own implementation solves every step from the first initial values; here each step starts from the previous
result, where one or two iterations of Levenberg-Marquardt are enough, which makes it tens of times faster.
"""

from __future__ import annotations

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from hybridlio.core.arrays import Array
from hybridlio.core.errors import GraphError
from hybridlio.graph.base.isam import gtsam_message
from hybridlio.graph.base.truncated_squares import GRADUATION, chi2_bound, first_control, truncated_weights
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.connectivity import components
from hybridlio.graph.model.edge_arrays import Edges, edges_of, loops_of
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.solve.builder import Builder, noise_model
from hybridlio.graph.solve.initial_values import find_initial_values
from hybridlio.graph.solve.nonlinear import IterationProgress, levenberg_marquardt_params, needs_qr, poses_of

_ITERATIONS_PER_STEP = 2  # each step starts close to its optimum
_MAX_STEPS = 200  # 1.4^200 is 1e29: all weights are 0 or 1 long before
# Where loops alone hold parts together, each keeps a trace of its weight, so that every step has a unique solution.
_SMALLEST_WEIGHT = 1e-9


def reject_outliers(data: GraphData, start: Array, report: IterationProgress) -> tuple[Array, frozenset[int]]:
    """Find the wrong loop closures and solve without them.

    Only between-factors of keys that are not consecutive may be wrong; all others are trusted.

    Args:
        data: the graph; its robust kernels are not used.
        start: coordinates ``(N, 7)`` or ``(N, 3)``; best without the loops, see :func:`odometry_start`.
        report: called with the sum of truncated χ² of the loops.

    Returns:
        Coordinates of all poses, and the ids of the wrong factors.

    Raises:
        GraphError: the graph cannot be solved.
    """
    loops = loops_of(data)
    if not loops:
        return start, frozenset()
    edges = edges_of(data)
    edges = edges.where(~edges.consecutive)
    builder = Builder(data.copy(without=loops))
    optimise = _WeightedSolver(builder.graph(robust=False), edges, data)
    bound = chi2_bound(data.tangent_size)
    weights = np.ones(len(loops))
    values = optimise(builder.values(start), weights)
    control = 0.0
    for step in range(_MAX_STEPS):
        chi2 = edges.chi2(co.to_matrices(poses_of(values, data.dimension)))
        control = control * GRADUATION if step else first_control(float(chi2.max()), bound)
        weights = truncated_weights(chi2, bound, control)
        report("rejecting", step, float(np.minimum(chi2, bound).sum()))
        if ((weights == 0) | (weights == 1)).all():
            break
        values = optimise(values, weights)
    wrong = np.array(loops)[weights < 0.5]
    return poses_of(values, data.dimension), frozenset(wrong.tolist())


def odometry_start(data: GraphData) -> Array | None:
    """Return coordinates along the odometry, which no wrong loop spoils, or None where it does not reach every pose."""
    try:
        return find_initial_values(data, "odometry")
    except GraphError:
        return None


class _WeightedSolver:
    """Runs a few iterations on the trusted factors and the weighted loops."""

    def __init__(self, trusted: gtsam.NonlinearFactorGraph, loops: Edges, data: GraphData) -> None:
        self._trusted, self._loops, self._dimension = trusted, loops, data.dimension
        self._measured = co.gtsam_poses(co.from_matrices(loops.T, data.dimension))
        self._params = levenberg_marquardt_params(needs_qr(data))
        self._params.setMaxIterations(_ITERATIONS_PER_STEP)
        without_loops = data.copy(without=loops_of(data))
        loops_join_parts = len(components(without_loops)) > len(components(data))
        self._smallest_weight = _SMALLEST_WEIGHT if loops_join_parts else 0.0
        self._factor = gtsam.BetweenFactorPose3 if data.dimension == 3 else gtsam.BetweenFactorPose2

    def __call__(self, values: gtsam.Values, weights: Array) -> gtsam.Values:
        graph = gtsam.NonlinearFactorGraph()
        graph.push_back(self._trusted)
        weights = np.maximum(weights, self._smallest_weight)
        information = weights[:, None, None] * self._loops.information
        for k in np.flatnonzero(weights):
            model = noise_model("information", information[k], None, self._dimension)
            ends = X(int(self._loops.i[k])), X(int(self._loops.j[k]))
            graph.add(self._factor(*ends, self._measured[k], model))
        try:
            return gtsam.LevenbergMarquardtOptimizer(graph, values, self._params).optimize()
        except RuntimeError as error:
            raise GraphError(f"the graph cannot be solved: {gtsam_message(error)}") from error
