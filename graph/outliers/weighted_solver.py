"""Solving a graph whose loop closures have weights, and the cost that rejection minimises."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from hybridlio.core.arrays import Array, Mask
from hybridlio.core.errors import GraphError
from hybridlio.graph.base.isam import gtsam_message
from hybridlio.graph.base.truncated_squares import first_control, truncated_weights
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.connectivity import components
from hybridlio.graph.model.edge_arrays import Edges
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.solve.builder import Builder, noise_model
from hybridlio.graph.solve.linear_solver import levenberg_marquardt_params, needs_qr, poses_of
from hybridlio.graph.solve.settings import IterationProgress

_ITERATIONS_PER_STEP = 2  # each step starts close to its optimum
_MAX_STEPS = 200  # 1.4^200 is 1e29: all weights are 0 or 1 long before
# Where loops alone hold parts together, each keeps a trace of its weight, so that every step has a unique solution.
_SMALLEST_WEIGHT = 1e-9
_REFINEMENTS, _REFINING_ITERATIONS = 10, 10  # of the set of correct loops, and of each solution of one


@dataclass(frozen=True, eq=False)
class Found:
    """The result of one search.

    Attributes:
        values: GTSAM's values, solved with the correct loops alone.
        correct: ``(M,)`` which loops are within the bound.
        cost: the truncated cost there.
    """

    values: gtsam.Values
    correct: Mask
    cost: float


class WeightedSolver:
    """Runs a few iterations on the trusted factors and the weighted loops.

    GTSAM's own graduated non-convexity solves every step from the first initial values; here each step starts from the
    previous result, where two iterations are enough, which makes it tens of times faster.

    Attributes:
        loops: the ``M`` between-factors of keys that are not consecutive.
        odometry: those of keys that are.
        bound: χ² up to which a loop counts as correct.
        dimension: 2 or 3.
        size: number of poses.
    """

    def __init__(
        self, trusted: GraphData, loops: Edges, odometry: Edges, bound: float, report: IterationProgress
    ) -> None:  # fmt: skip
        self.loops, self.odometry, self.bound = loops, odometry, bound
        self.dimension, self._report = trusted.dimension, report
        self.size = len(trusted)
        self._builder = Builder(trusted)
        self._trusted = self._builder.graph(robust=False)
        self._measured = co.gtsam_poses(co.from_matrices(loops.T, self.dimension))
        self._params = levenberg_marquardt_params(needs_qr(trusted))
        part = {key: number for number, keys in enumerate(components(trusted)) for key in keys}
        keys = trusted.keys
        join_parts = any(part[keys[i]] != part[keys[j]] for i, j in zip(loops.i, loops.j, strict=True))
        self._smallest_weight = _SMALLEST_WEIGHT if join_parts else 0.0
        self._factor = gtsam.BetweenFactorPose3 if self.dimension == 3 else gtsam.BetweenFactorPose2
        self._in_full = [self._make(k, loops.information[k]) for k in range(len(loops.i))]

    def _make(self, k: int, information: Array) -> Any:
        model = noise_model("information", information, None, self.dimension)
        return self._factor(X(int(self.loops.i[k])), X(int(self.loops.j[k])), self._measured[k], model)

    def values(self, start: Array) -> gtsam.Values:
        """Return GTSAM's values at coordinates ``(N, 7)`` or ``(N, 3)``."""
        return self._builder.values(start)

    def poses(self, values: gtsam.Values) -> Array:
        """Return the poses ``(N, 4, 4)``."""
        return co.to_matrices(poses_of(values, self.dimension))

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
        for k in np.flatnonzero(weights).tolist():
            weight = weights[k]
            graph.add(self._in_full[k] if weight == 1 else self._make(k, weight * self.loops.information[k]))
        self._params.setMaxIterations(iterations)
        try:
            return gtsam.LevenbergMarquardtOptimizer(graph, values, self._params).optimize()
        except RuntimeError as error:
            raise GraphError(f"the graph cannot be solved: {gtsam_message(error)}") from error

    def cost_with(self, values: gtsam.Values, loops: Mask) -> float:
        """Return χ² of all trusted factors and of some loops: no solution with these loops costs less."""
        return float(2 * self._trusted.error(values) + self.chi2(values)[loops].sum())

    def graduate(
        self, values: gtsam.Values, candidates: Mask, bound: float, graduation: float, largest: float = np.inf,
        held: Mask | None = None,
    ) -> tuple[gtsam.Values, Mask]:  # fmt: skip
        """Find the correct ones of some loops by graduated non-convexity (Yang et al., RA-L 2020, section IV).

        Args:
            values: to start from.
            candidates: ``(M,)`` the loops; all others are left out.
            bound: χ² up to which a loop counts as correct.
            graduation: factor by which the control parameter grows at every step.
            largest: χ² from which graduation starts at most, in units of the bound.
            held: ``(M,)`` loops that keep their full weight.
        """
        control, weights = 0.0, np.zeros(len(candidates))
        for step in range(_MAX_STEPS if candidates.any() else 0):
            chi2 = self.chi2(values)
            first = min(float(chi2[candidates].max()), largest * bound)
            control = control * graduation if step else first_control(first, bound)
            weights = np.where(candidates, truncated_weights(chi2, bound, control), 0.0)
            weights = weights if held is None else np.where(held, 1.0, weights)
            self._report("rejecting", step, float(np.minimum(chi2[candidates], bound).sum()))
            if ((weights == 0) | (weights == 1)).all():
                break
            values = self.solve(values, weights)
        return values, weights >= 0.5

    def found(self, values: gtsam.Values, correct: Mask) -> Found:
        """Solve with the correct loops alone, and take those within the bound, until they stay the same."""
        for _ in range(_REFINEMENTS):
            values = self.solve(values, correct.astype(np.float64), _REFINING_ITERATIONS)
            before, correct = correct, self.chi2(values) <= self.bound
            if np.array_equal(correct, before):
                break
        return Found(values, correct, self.cost(values))
