"""Solving a graph whose loop closures have weights, and the cost that rejection minimises."""

from __future__ import annotations

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from hybridlio.core.arrays import Array, Mask
from hybridlio.core.errors import GraphError
from hybridlio.graph.base.isam import gtsam_message
from hybridlio.graph.base.truncated_squares import first_control, truncated_weights
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.connectivity import components
from hybridlio.graph.model.edge_arrays import edges_of, loops_of
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.solve.builder import Builder, noise_model
from hybridlio.graph.solve.linear_solver import levenberg_marquardt_params, needs_qr, poses_of
from hybridlio.graph.solve.settings import IterationProgress

_ITERATIONS_PER_STEP = 2  # each step starts close to its optimum
_MAX_STEPS = 200  # 1.4^200 is 1e29: all weights are 0 or 1 long before
# Where loops alone hold parts together, each keeps a trace of its weight, so that every step has a unique solution.
_SMALLEST_WEIGHT = 1e-9
_REFINEMENTS, _REFINING_ITERATIONS = 10, 10  # of the set of correct loops, and of each solution of one


class WeightedSolver:
    """Runs a few iterations on the trusted factors and the weighted loops.

    GTSAM's own graduated non-convexity solves every step from the first initial values; here each step starts from the
    previous result, where two iterations are enough, which makes it tens of times faster.

    Attributes:
        loops: the ``M`` between-factors of keys that are not consecutive.
        odometry: those of keys that are.
        bound: χ² up to which a loop counts as correct.
    """

    def __init__(self, data: GraphData, bound: float, report: IterationProgress) -> None:
        edges = edges_of(data)
        self.loops, self.odometry, self.bound = edges.where(~edges.consecutive), edges.where(edges.consecutive), bound
        self._dimension, self._report = data.dimension, report
        without_loops = data.copy(without=loops_of(data))
        self._builder = Builder(without_loops)
        self._trusted = self._builder.graph(robust=False)
        self._measured = co.gtsam_poses(co.from_matrices(self.loops.T, data.dimension))
        self._params = levenberg_marquardt_params(needs_qr(data))
        loops_join_parts = len(components(without_loops)) > len(components(data))
        self._smallest_weight = _SMALLEST_WEIGHT if loops_join_parts else 0.0
        self._factor = gtsam.BetweenFactorPose3 if data.dimension == 3 else gtsam.BetweenFactorPose2

    def values(self, start: Array) -> gtsam.Values:
        """Return GTSAM's values at coordinates ``(N, 7)`` or ``(N, 3)``."""
        return self._builder.values(start)

    def poses(self, values: gtsam.Values) -> Array:
        """Return the poses ``(N, 4, 4)``."""
        return co.to_matrices(poses_of(values, self._dimension))

    def chi2(self, values: gtsam.Values) -> Array:
        """Return χ² ``(M,)`` of the loops."""
        return self.loops.chi2(self.poses(values))

    def cost(self, values: gtsam.Values) -> float:
        """Return the truncated cost: χ² of all trusted factors, and of each loop up to the bound."""
        return float(2 * self._trusted.error(values) + np.minimum(self.chi2(values), self.bound).sum())

    def solve(self, values: gtsam.Values, weights: Array, iterations: int = _ITERATIONS_PER_STEP) -> gtsam.Values:
        """Return values after some iterations with loops of weights ``(M,)``.

        Raises:
            GraphError: the graph cannot be solved.
        """
        graph = gtsam.NonlinearFactorGraph()
        graph.push_back(self._trusted)
        weights = np.maximum(weights, self._smallest_weight)
        information = weights[:, None, None] * self.loops.information
        for k in np.flatnonzero(weights):
            model = noise_model("information", information[k], None, self._dimension)
            ends = X(int(self.loops.i[k])), X(int(self.loops.j[k]))
            graph.add(self._factor(*ends, self._measured[k], model))
        self._params.setMaxIterations(iterations)
        try:
            return gtsam.LevenbergMarquardtOptimizer(graph, values, self._params).optimize()
        except RuntimeError as error:
            raise GraphError(f"the graph cannot be solved: {gtsam_message(error)}") from error

    def graduate(
        self, values: gtsam.Values, candidates: Mask, bound: float, graduation: float, largest: float = np.inf
    ) -> tuple[gtsam.Values, Mask]:  # fmt: skip
        """Find the correct ones of some loops by graduated non-convexity (Yang et al., RA-L 2020, section IV).

        Args:
            values: to start from.
            candidates: ``(M,)`` the loops; all others are left out.
            bound: χ² up to which a loop counts as correct.
            graduation: factor by which the control parameter grows at every step.
            largest: χ² from which graduation starts at most, in units of the bound.
        """
        control, weights = 0.0, np.zeros(len(candidates))
        for step in range(_MAX_STEPS):
            chi2 = self.chi2(values)
            first = min(float(chi2[candidates].max()), largest * bound)
            control = control * graduation if step else first_control(first, bound)
            weights = np.where(candidates, truncated_weights(chi2, bound, control), 0.0)
            self._report("rejecting", step, float(np.minimum(chi2[candidates], bound).sum()))
            if ((weights == 0) | (weights == 1)).all():
                break
            values = self.solve(values, weights)
        return values, weights >= 0.5

    def refine(self, values: gtsam.Values, correct: Mask) -> tuple[gtsam.Values, Mask]:
        """Solve with the correct loops alone, and take those within the bound, until they stay the same."""
        for _ in range(_REFINEMENTS):
            values = self.solve(values, correct.astype(np.float64), _REFINING_ITERATIONS)
            before, correct = correct, self.chi2(values) <= self.bound
            if np.array_equal(correct, before):
                break
        return values, correct
