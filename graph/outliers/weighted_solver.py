"""Solving a graph whose loop closures have weights, and the cost that rejection minimises."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import count
from typing import Any, Protocol

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from hybridlio.core.arrays import Array, Mask
from hybridlio.core.errors import GraphError
from hybridlio.graph.base.isam import gtsam_message
from hybridlio.graph.base.truncated_squares import graduate
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.connectivity import components
from hybridlio.graph.model.edge_arrays import Edges
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.outliers.loop_support import LoopSupport
from hybridlio.graph.planar.edges import PlanarEdges
from hybridlio.graph.planar.gauss_newton import as_planar, held_poses, planar_edges, solves
from hybridlio.graph.planar.system import PlanarSystem
from hybridlio.graph.solve.builder import Builder, noise_model
from hybridlio.graph.solve.linear_solver import levenberg_marquardt_params, needs_qr, poses_of
from hybridlio.graph.solve.settings import TOLERANCE, IterationProgress

_ITERATIONS_PER_STEP = 2  # each step starts close to its optimum
# Where loops alone hold parts together, each keeps a trace of its weight, so that every step has a unique solution.
_SMALLEST_WEIGHT = 1e-9
_REFINEMENTS, _REFINING_ITERATIONS = 10, 10  # of the set of correct loops, and of each solution of one
# What each further loop of a cluster adds to the cost of rejecting all of it, in units of a single loop's. Loops that
# confirm one another are not independent: what misled one, two places that look alike, misleads its neighbours as well.
# Chosen on seeds 0 to 4 of MIT with groups of five wrong loops.
_FURTHER_LOOP = 0.25
# Levenberg-Marquardt's damping as GTSAM's: at the start, its factor from try to try, and where it gives up.
_FIRST_DAMPING, _DAMPING_FACTOR, _LARGEST_DAMPING = 1e-5, 10.0, 1e5
# Loops below which GTSAM's descent is the faster one: two iterations on the 20 of MIT take it 0.7 ms, and arrays
# 1.6; on kitti_02's 43 loops 1.8 against 1.2, on intel's 785 40 against 14, on M3500's 2,099 120 against 28.
_FEW_LOOPS = 40


class Descent(Protocol):
    """Moves the poses of a graph downhill. A state is opaque: GTSAM's values, or an array."""

    def state(self, coordinates: Array) -> Any:
        """Return the state at coordinates ``(N, 7)`` or ``(N, 3)``."""

    def coordinates(self, state: Any) -> Array:
        """Return the coordinates of a state."""

    def trusted_chi2(self, state: Any) -> float:
        """Return the sum of χ² of the trusted factors."""

    def solve(self, state: Any, weights: Array, iterations: int) -> Any:
        """Return the state after some iterations with loops of weights ``(M,)``; raise GraphError where it fails."""


def descent(trusted: GraphData, loops: Edges) -> Descent:
    """Return the quickest descent for a graph of trusted factors, without their robust kernels, and loops."""
    in_arrays = solves(trusted) and len(loops.i) >= _FEW_LOOPS
    return PlanarDescent(trusted, loops) if in_arrays else GtsamDescent(trusted, loops)


class GtsamDescent:
    """Any factors, by GTSAM."""

    def __init__(self, trusted: GraphData, loops: Edges) -> None:
        self._loops, self._dimension = loops, trusted.dimension
        self._builder = Builder(trusted)
        self._trusted = self._builder.graph(robust=False)
        self._measured = co.gtsam_poses(co.from_matrices(loops.T, self._dimension))
        self._params = levenberg_marquardt_params(needs_qr(trusted))
        self._factor = gtsam.BetweenFactorPose3 if self._dimension == 3 else gtsam.BetweenFactorPose2
        self._in_full = [self._make(k, loops.information[k]) for k in range(len(loops.i))]

    def _make(self, k: int, information: Array) -> Any:
        model = noise_model("information", information, None, self._dimension)
        return self._factor(X(int(self._loops.i[k])), X(int(self._loops.j[k])), self._measured[k], model)

    def state(self, coordinates: Array) -> gtsam.Values:
        """See :class:`Descent`."""
        return self._builder.values(coordinates)

    def coordinates(self, state: gtsam.Values) -> Array:
        """See :class:`Descent`."""
        return poses_of(state, self._dimension)

    def trusted_chi2(self, state: gtsam.Values) -> float:
        """See :class:`Descent`."""
        return float(2 * self._trusted.error(state))

    def solve(self, state: gtsam.Values, weights: Array, iterations: int) -> gtsam.Values:
        """See :class:`Descent`."""
        graph = gtsam.NonlinearFactorGraph()
        graph.push_back(self._trusted)
        for k in np.flatnonzero(weights).tolist():
            weight = weights[k]
            graph.add(self._in_full[k] if weight == 1 else self._make(k, weight * self._loops.information[k]))
        self._params.setMaxIterations(iterations)
        try:
            return gtsam.LevenbergMarquardtOptimizer(graph, state, self._params).optimize()
        except RuntimeError as error:
            raise GraphError(f"the graph cannot be solved: {gtsam_message(error)}") from error


class PlanarDescent:
    """Relative poses and priors in the plane; a state is an array ``(3, N + 1)``, the last pose that of the origin.

    The system is made for the loops that have a weight, and kept while these are the same.
    """

    def __init__(self, trusted: GraphData, loops: Edges) -> None:
        self._trusted, self._held = planar_edges(trusted), held_poses(trusted)
        ends = np.column_stack([loops.i, loops.j])
        self._loops = as_planar(ends, co.from_matrices(loops.T, 2), loops.information)
        self._active: Mask = np.zeros(len(loops.i), dtype=bool)
        self._edges, self._system = self._trusted, PlanarSystem(self._trusted, self._held)

    def state(self, coordinates: Array) -> Array:
        """See :class:`Descent`."""
        return np.concatenate([coordinates, np.zeros((1, 3))]).T.copy()

    def coordinates(self, state: Array) -> Array:
        """See :class:`Descent`."""
        return np.ascontiguousarray(state[:, :-1].T)

    def trusted_chi2(self, state: Array) -> float:
        """See :class:`Descent`."""
        return float(self._trusted.chi2(state).sum())

    def solve(self, state: Array, weights: Array, iterations: int) -> Array:
        """See :class:`Descent`."""
        edges, system = self._with_loops(weights != 0)
        scale = np.concatenate([np.ones(len(self._trusted.i)), weights[weights != 0]])
        information, damping = edges.information * scale, _FIRST_DAMPING
        error = float((scale * edges.chi2(state)).sum())
        for _ in range(iterations):
            while True:
                moved = state + system.step(state, information, damping)
                after = float((scale * edges.chi2(moved)).sum())
                if after <= error:
                    break
                damping *= _DAMPING_FACTOR
                if damping > _LARGEST_DAMPING:
                    return state
            gained, state, error = error - after, moved, after
            damping /= _DAMPING_FACTOR
            if gained <= TOLERANCE * error:
                break
        return state

    def _with_loops(self, active: Mask) -> tuple[PlanarEdges, PlanarSystem]:
        """Return the trusted edges and some loops, and their system."""
        if not np.array_equal(active, self._active):
            some = zip(self._trusted, self._loops, strict=True)
            self._edges = PlanarEdges(*(np.concatenate([kept, more[..., active]], axis=-1) for kept, more in some))
            self._active, self._system = active, PlanarSystem(self._edges, self._held)
        return self._edges, self._system


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
    """Return the result of least cost among those that no other dominates.

    One that keeps the same loops and more, and costs less in full, dominates: the discount on rejecting a cluster is to
    weigh groups that contradict each other, not to reject loops that contradict nothing.
    """

    def is_dominated(one: Found) -> bool:
        return any((other.correct >= one.correct).all() and other.full_cost < one.full_cost for other in found)

    return min((one for one in found if not is_dominated(one)), key=lambda one: one.cost)


class WeightedSolver:
    """Runs a few iterations on the trusted factors and the weighted loops.

    In graduation each step starts from the previous result, where two iterations are enough.

    Attributes:
        loops: the ``M`` between-factors of keys that are not consecutive.
        odometry: those of keys that are.
        bound: χ² up to which a loop counts as correct.
        price: cost of rejecting a loop that no other confirms, and the most that one costs: the bound, lowered where
            loops show that all noise is stated too large, so that bending the map does not cost less than rejection.
        dimension: 2 or 3.
        size: number of poses.
    """

    def __init__(
        self, trusted: GraphData, loops: Edges, odometry: Edges, bound: float, report: IterationProgress,
        support: LoopSupport | None = None,
    ) -> None:  # fmt: skip
        self.loops, self.odometry, self.bound = loops, odometry, bound
        self.price = bound if support is None else bound * support.scale
        self.dimension, self._report = trusted.dimension, report
        self.size = len(trusted)
        self._cluster = np.arange(len(loops.i)) if support is None else support.cluster
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
        """Return χ² of trusted factors and of loops up to the price; of a rejected cluster as _FURTHER_LOOP says."""
        return self._costs(values)[0]

    def _costs(self, values: Any) -> tuple[float, float]:
        """Return the truncated cost, and the same with every rejected loop counted in full."""
        chi2 = self.chi2(values)
        rejected = np.bincount(self._cluster, chi2 > self.bound)
        limits = 1 + _FURTHER_LOOP * (np.bincount(self._cluster) - 1)
        kept = self._descent.trusted_chi2(values) + np.minimum(chi2, self.price)[chi2 <= self.bound].sum()
        return float(kept + self.price * np.minimum(rejected, limits).sum()), float(kept + self.price * rejected.sum())

    def solve(self, values: Any, weights: Array, iterations: int = _ITERATIONS_PER_STEP) -> Any:
        """Return values after some iterations with loops of weights ``(M,)``.

        Raises:
            GraphError: the graph cannot be solved.
        """
        return self._descent.solve(values, np.maximum(weights, self._smallest_weight), iterations)

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
        """Solve with the correct loops alone, and take those within the bound, until they stay the same."""
        for _ in range(_REFINEMENTS):
            values = self.solve(values, correct.astype(np.float64), _REFINING_ITERATIONS)
            before, correct = correct, self.chi2(values) <= self.bound
            if np.array_equal(correct, before):
                break
        return Found(values, correct, *self._costs(values))
