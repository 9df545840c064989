"""Solving a graph whose loop closures have weights, and the cost that rejection minimises."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from hybridlio.core.arrays import Array, Index, Mask
from hybridlio.graph.base.truncated_squares import first_control, truncated_weights
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.connectivity import components
from hybridlio.graph.model.edge_arrays import Edges
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.outliers.descent import Descent, descent
from hybridlio.graph.solve.settings import IterationProgress

_ITERATIONS_PER_STEP = 2  # each step starts close to its optimum
_MAX_STEPS = 200  # 1.4^200 is 1e29: all weights are 0 or 1 long before
# Where loops alone hold parts together, each keeps a trace of its weight, so that every step has a unique solution.
_SMALLEST_WEIGHT = 1e-9
_REFINEMENTS, _REFINING_ITERATIONS = 10, 10  # of the set of correct loops, and of each solution of one
# What each further loop of a cluster adds to the cost of rejecting all of it, in units of a single loop's. Loops that
# confirm one another are not independent: what misled one, two places that look alike, misleads its neighbours as well.
# Chosen on seeds 0 to 4 of MIT with groups of five wrong loops.
_FURTHER_LOOP = 0.25


@dataclass(frozen=True, eq=False)
class Found:
    """The result of one search.

    Attributes:
        values: the state, solved with the correct loops alone.
        correct: ``(M,)`` which loops are within the bound.
        cost: the truncated cost there.
    """

    values: Any
    correct: Mask
    cost: float


class WeightedSolver:
    """Runs a few iterations on the trusted factors and the weighted loops.

    GTSAM's own graduated non-convexity solves every step from the first initial values; here each step starts from the
    previous result, where two iterations are enough, which makes it tens of times faster.

    Attributes:
        loops: the ``M`` between-factors of keys that are not consecutive.
        odometry: those of keys that are.
        bound: χ² up to which a loop counts as correct, and the cost of rejecting one that no other confirms.
        dimension: 2 or 3.
        size: number of poses.
    """

    def __init__(
        self, trusted: GraphData, loops: Edges, odometry: Edges, bound: float, report: IterationProgress,
        cluster: Index | None = None,
    ) -> None:  # fmt: skip
        self.loops, self.odometry, self.bound = loops, odometry, bound
        self.dimension, self._report = trusted.dimension, report
        self.size = len(trusted)
        self._cluster = np.arange(len(loops.i)) if cluster is None else cluster
        self._descent: Descent = descent(trusted, loops)
        part = {key: number for number, keys in enumerate(components(trusted)) for key in keys}
        keys = trusted.keys
        join_parts = any(part[keys[i]] != part[keys[j]] for i, j in zip(loops.i, loops.j, strict=True))
        self._smallest_weight = _SMALLEST_WEIGHT if join_parts else 0.0

    def values(self, start: Array) -> Any:
        """Return the state at coordinates ``(N, 7)`` or ``(N, 3)``."""
        return self._descent.state(start)

    def coordinates(self, values: Any) -> Array:
        """Return the coordinates ``(N, 7)`` or ``(N, 3)`` of a state."""
        return self._descent.coordinates(values)

    def poses(self, values: Any) -> Array:
        """Return the poses ``(N, 4, 4)``."""
        return co.to_matrices(self.coordinates(values))

    def chi2(self, values: Any) -> Array:
        """Return χ² ``(M,)`` of the loops."""
        return self.loops.chi2(self.poses(values))

    def cost(self, values: Any) -> float:
        """Return the truncated cost: χ² of all trusted factors and of each loop up to the bound.

        A cluster whose loops are rejected costs at most as much as :data:`_FURTHER_LOOP` says.
        """
        chi2 = self.chi2(values)
        sizes = np.bincount(self._cluster)
        rejected = np.bincount(self._cluster, chi2 > self.bound)
        rejections = np.minimum(rejected, 1 + _FURTHER_LOOP * (sizes - 1)).sum()
        kept = chi2[chi2 <= self.bound].sum()
        return float(self._descent.trusted_chi2(values) + kept + self.bound * rejections)

    def solve(self, values: Any, weights: Array, iterations: int = _ITERATIONS_PER_STEP) -> Any:
        """Return values after some iterations with loops of weights ``(M,)``.

        Raises:
            GraphError: the graph cannot be solved.
        """
        return self._descent.solve(values, np.maximum(weights, self._smallest_weight), iterations)

    def cost_with(self, values: Any, loops: Mask) -> float:
        """Return χ² of all trusted factors and of some loops: no solution with these loops costs less."""
        return float(self._descent.trusted_chi2(values) + self.chi2(values)[loops].sum())

    def graduate(
        self, values: Any, candidates: Mask, bound: float, graduation: float, largest: float = np.inf,
        held: Mask | None = None,
    ) -> tuple[Any, Mask]:  # fmt: skip
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

    def found(self, values: Any, correct: Mask) -> Found:
        """Solve with the correct loops alone, and take those within the bound, until they stay the same."""
        for _ in range(_REFINEMENTS):
            values = self.solve(values, correct.astype(np.float64), _REFINING_ITERATIONS)
            before, correct = correct, self.chi2(values) <= self.bound
            if np.array_equal(correct, before):
                break
        return Found(values, correct, self.cost(values))
