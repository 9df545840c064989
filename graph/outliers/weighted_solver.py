"""Solving a graph whose loop closures have weights, and the cost that rejection minimises."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import count
from typing import Any, Protocol

import numpy as np

from hybridlio.core.arrays import Array, Mask
from hybridlio.graph.base.truncated_squares import graduate
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.connectivity import components
from hybridlio.graph.model.edge_arrays import Edges
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.outliers.linear_changes import Linear
from hybridlio.graph.outliers.loop_support import LoopSupport
from hybridlio.graph.solve.settings import IterationProgress

_ITERATIONS_PER_STEP = 2  # each step starts close to its optimum
# Where loops alone hold parts together, each keeps a trace of its weight, so that every step has a unique solution.
_SMALLEST_WEIGHT = 1e-9
_REFINEMENTS, _REFINING_ITERATIONS = 10, 10  # of the set of correct loops, and of each solution of one
# What each further loop of a cluster adds to the cost of rejecting all of it, in units of a single loop's. Loops that
# confirm one another are not independent: what misled one, two places that look alike, misleads its neighbours as well.
# Chosen on seeds 0 to 4 of MIT with groups of five wrong loops.
_FURTHER_LOOP = 0.25
# Loops of a cluster that are counted at that. One place that misleads explains no more: without a limit, a cluster that
# most loops of a small map belong to would be rejected for a quarter of what its loops are worth.
LARGEST_GROUP = 20
# Factor on the price from which a loop is contradicted to first order: far off, the linear model is a poor one. Where
# noise is stated too large it is also the factor from which a loop is wrong, on what this share of accepted ones shows.
FAR_OFF = 10.0
_SHOWING = 0.99  # the last per cent of parking-garage's correct loops is up to twelve times the price


class Descent(Protocol):
    """Moves the poses of a graph downhill. A state is opaque: GTSAM's values, or an array.

    Attributes:
        trusted: the graph without loops.
        loops: the ``M`` loops.
    """

    trusted: GraphData
    loops: Edges

    def state(self, coordinates: Array) -> Any:
        """Return the state at coordinates ``(N, 7)`` or ``(N, 3)``."""

    def coordinates(self, state: Any) -> Array:
        """Return the coordinates of a state."""

    def trusted_chi2(self, state: Any) -> float:
        """Return the sum of χ² of the trusted factors."""

    def linear(self, state: Any) -> Linear:
        """Return trusted factors and loops around a state."""

    def solve(self, state: Any, weights: Array, iterations: int) -> Any:
        """Return the state after some iterations with loops of weights ``(M,)``; raise GraphError where it fails."""


@dataclass(frozen=True, eq=False)
class Found:
    """The result of one search.

    Attributes:
        values: the state, solved with the correct loops alone.
        correct: ``(M,)`` which loops are within the bound.
        cost: the truncated cost there.
        full_cost: the same with every rejected loop counted as one that nothing confirms.
    """

    values: Any
    correct: Mask
    cost: float
    full_cost: float


def least(found: list[Found]) -> Found:
    """Return the result of least cost among those that no other dominates."""
    return min(undominated(found), key=lambda one: one.cost)


def undominated(found: list[Found]) -> list[Found]:
    """Return the results that no other dominates.

    One that keeps the same loops and more, and costs less in full, dominates: the discount on rejecting a cluster is to
    weigh groups that contradict each other, not to reject loops that contradict nothing.
    """

    def is_dominated(one: Found) -> bool:
        return any((other.correct >= one.correct).all() and other.full_cost < one.full_cost for other in found)

    return [one for one in found if not is_dominated(one)]


class WeightedSolver:
    """Runs a few iterations on the trusted factors and the weighted loops.

    In graduation each step starts from the previous result, where two iterations are enough.

    Attributes:
        loops: the ``M`` between-factors of keys that are not consecutive.
        odometry: those of keys that are.
        bound: χ² up to which a loop counts as correct with the noise as stated.
        price: cost of rejecting a loop that no other confirms, and the most that one costs: the bound, lowered where
            loops show that all noise is stated too large, so that bending the map does not cost less than rejection.
        dimension: 2 or 3.
        size: number of poses.
    """

    def __init__(
        self, descent: Descent, odometry: Edges, bound: float, report: IterationProgress,
        support: LoopSupport | None = None,
    ) -> None:  # fmt: skip
        trusted, self.loops = descent.trusted, descent.loops
        self.odometry, self.bound = odometry, bound
        self.price = bound if support is None else bound * support.scale
        self.dimension, self._report = trusted.dimension, report
        self.size = len(trusted)
        self._cluster = np.arange(len(self.loops.i)) if support is None else support.cluster
        self._descent = descent
        part = {key: number for number, keys in enumerate(components(trusted)) for key in keys}
        keys, ends = trusted.keys, zip(self.loops.i, self.loops.j, strict=True)
        join_parts = any(part[keys[i]] != part[keys[j]] for i, j in ends)
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
        """Return χ² of trusted factors and of loops up to the price; of a rejected cluster as _FURTHER_LOOP says."""
        return self._costs(values, self.chi2(values) <= self.bound)[0]

    def _costs(self, values: Any, correct: Mask) -> tuple[float, float]:
        """Return the truncated cost, and the same with every rejected loop counted in full."""
        chi2 = self.chi2(values)
        kept = float(self._descent.trusted_chi2(values) + np.minimum(chi2, self.price)[correct].sum())
        return kept + self.cost_of_rejecting(~correct), kept + self.price * np.count_nonzero(~correct)

    def cost_of_rejecting(self, loops: Mask) -> float:
        """Return what it costs to reject some loops ``(M,)``."""
        sizes = np.bincount(self._cluster)
        limits = sizes - (1 - _FURTHER_LOOP) * (np.minimum(sizes, LARGEST_GROUP) - 1)
        return float(self.price * np.minimum(np.bincount(self._cluster, loops), limits).sum())

    def solve(self, values: Any, weights: Array, iterations: int = _ITERATIONS_PER_STEP) -> Any:
        """Return values after some iterations with loops of weights ``(M,)``.

        Raises:
            GraphError: the graph cannot be solved.
        """
        return self._descent.solve(values, np.maximum(weights, self._smallest_weight), iterations)

    def linear(self, values: Any) -> Linear:
        """Return trusted factors and loops around a state."""
        return self._descent.linear(values)

    def cost_with(self, values: Any, loops: Mask) -> float:
        """Return χ² of all trusted factors and of some loops up to the price: no solution with these costs less."""
        return float(self._descent.trusted_chi2(values) + np.minimum(self.chi2(values)[loops], self.price).sum())

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
        steps, weights = count(), np.zeros(len(candidates))

        def chi2(values: Any) -> Array:
            found = self.chi2(values)[candidates]
            self._report("rejecting", next(steps), float(np.minimum(found, bound).sum()))
            return found

        def solve(values: Any, weights_of_candidates: Array) -> Any:
            weights[candidates] = weights_of_candidates
            return self.solve(values, weights)

        held = None if held is None else held[candidates]
        found = graduate(values, chi2, solve, bound, growth=graduation, largest=largest, held=held)
        values, weights[candidates] = found
        return values, weights >= 0.5

    def found(self, values: Any, correct: Mask) -> Found:
        """Solve with the correct loops alone, and take those within the limit, until they stay the same."""
        for _ in range(_REFINEMENTS):
            values = self.solve(values, correct.astype(np.float64), _REFINING_ITERATIONS)
            before, correct = correct, self._within_limit(self.chi2(values), correct)
            if np.array_equal(correct, before):
                break
        return Found(values, correct, *self._costs(values, correct))

    def _within_limit(self, chi2: Array, correct: Mask) -> Mask:
        """Return which loops ``(M,)`` are within the bound, and not far beyond the noise that the correct ones show.

        With noise that is stated ten times too large a wrong loop within the bound bends a map as much as it likes:
        parking-garage keeps three of 462, which move it by 4 % of its spread.
        """
        shown = max(self.price, float(np.quantile(chi2[correct], _SHOWING)) if correct.any() else 0.0)
        return chi2 <= min(self.bound, FAR_OFF * shown)
