"""Finding wrong loop closures by graduated non-convexity with truncated least squares.

Yang, Antonante, Tzoumas, Carlone, "Graduated non-convexity for robust spatial perception" (RA-L 2020), section IV.
GTSAM's own optimiser solves every step anew from the first guess; here each step goes on from the one before, where one
or two iterations of Levenberg-Marquardt are enough, which makes it tens of times quicker.
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
from hybridlio.graph.model.checks import components
from hybridlio.graph.model.edge_arrays import Edges, edges_of, loops_of
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.solve.build import Builder, noise_model
from hybridlio.graph.solve.levenberg import Progress, needs_orthogonal, parameters, poses_of
from hybridlio.graph.solve.starts import find

_ITERATIONS_A_STEP = 2
_STEPS = 200
_LEAST_WEIGHT = 1e-9  # where the loops hold parts together, each keeps a trace


def reject_outliers(data: GraphData, start: Array, report: Progress) -> tuple[Array, frozenset[int]]:
    """Which loop closures are wrong, and where the other factors put the poses.

    All but between-factors of keys that are not consecutive are taken for right.

    Args:
        data: the graph; its robust kernels are not used.
        start: coordinates ``(N, 7)`` or ``(N, 3)``; best without the loops, see :func:`start_without_loops`.
        report: told the sum of the squared, truncated residuals.

    Returns:
        Coordinates, and the ids of the wrong factors.

    Raises:
        GraphError: the graph cannot be solved.
    """
    loops = loops_of(data)
    if not loops:
        return start, frozenset()
    edges = edges_of(data)
    edges = edges.where(~edges.steps)
    builder = Builder(data.without(loops))
    optimise = _Weighted(builder.graph(robust=False), edges, data)
    bound = chi2_bound(co.TANGENT_SIZE[data.dimension])
    weights = np.ones(len(loops))
    values = optimise(builder.values(start), weights)
    control = 0.0
    for step in range(_STEPS):
        chi2 = edges.chi2(co.to_matrices(poses_of(values, data.dimension)))
        control = control * GRADUATION if step else first_control(float(chi2.max()), bound)
        weights = truncated_weights(chi2, bound, control)
        report("rejecting", step, float(np.minimum(chi2, bound).sum()))
        if ((weights == 0) | (weights == 1)).all():
            break
        values = optimise(values, weights)
    wrong = np.array(loops)[weights < 0.5]
    return poses_of(values, data.dimension), frozenset(wrong.tolist())


def start_without_loops(data: GraphData) -> Array | None:
    """Coordinates along the odometry, which no wrong loop spoils; None where it does not reach every pose."""
    try:
        return find(data, "odometry")
    except GraphError:
        return None


class _Weighted:
    """A few iterations on the sure factors and the loops at their weights."""

    def __init__(self, sure: gtsam.NonlinearFactorGraph, edges: Edges, data: GraphData) -> None:
        self._sure, self._edges, self._dimension = sure, edges, data.dimension
        self._measured = co.gtsam_poses(co.from_matrices(edges.T, data.dimension))
        self._params = parameters(needs_orthogonal(data))
        self._params.setMaxIterations(_ITERATIONS_A_STEP)
        self._needed = len(components(data.without(loops_of(data)))) > len(components(data))
        self._factor = gtsam.BetweenFactorPose3 if data.dimension == 3 else gtsam.BetweenFactorPose2

    def __call__(self, values: gtsam.Values, weights: Array) -> gtsam.Values:
        graph = gtsam.NonlinearFactorGraph()
        graph.push_back(self._sure)
        weights = np.maximum(weights, _LEAST_WEIGHT if self._needed else 0.0)
        information = weights[:, None, None] * self._edges.information
        for k in np.flatnonzero(weights):
            model = noise_model("information", information[k], None, self._dimension)
            graph.add(self._factor(X(int(self._edges.i[k])), X(int(self._edges.j[k])), self._measured[k], model))
        try:
            return gtsam.LevenbergMarquardtOptimizer(graph, values, self._params).optimize()
        except RuntimeError as error:
            raise GraphError(f"the graph cannot be solved: {gtsam_message(error)}") from error
