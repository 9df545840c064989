"""Descents: how a graph of trusted factors and weighted loop closures is solved, by GTSAM or in arrays."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X
from scipy.sparse import csr_matrix

from hybridlio.core.arrays import Array, Mask
from hybridlio.core.errors import GraphError
from hybridlio.graph.base.isam import gtsam_message
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.edge_arrays import Edges
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.outliers.linear_changes import Linear
from hybridlio.graph.outliers.weighted_solver import Descent
from hybridlio.graph.planar.edges import PlanarEdges
from hybridlio.graph.planar.gauss_newton import as_planar, held_poses, planar_edges, solves
from hybridlio.graph.planar.system import PlanarSystem
from hybridlio.graph.solve.builder import Builder, noise_model
from hybridlio.graph.solve.linear_solver import levenberg_marquardt_params, needs_qr, poses_of
from hybridlio.graph.solve.settings import TOLERANCE

# Levenberg-Marquardt's damping as GTSAM's: at the start, its factor from try to try, and where it gives up.
_FIRST_DAMPING, _DAMPING_FACTOR, _LARGEST_DAMPING = 1e-5, 10.0, 1e5
# Loops below which GTSAM's descent is the faster one: two iterations on the 20 of MIT take it 0.7 ms, and arrays
# 1.6; on kitti_02's 43 loops 1.8 against 1.2, on intel's 785 40 against 14, on M3500's 2,099 120 against 28.
_FEW_LOOPS = 40


def descent(trusted: GraphData, loops: Edges) -> Descent:
    """Return the quickest descent for a graph of trusted factors, without their robust kernels, and loops."""
    in_arrays = solves(trusted) and len(loops.i) >= _FEW_LOOPS
    return PlanarDescent(trusted, loops) if in_arrays else GtsamDescent(trusted, loops)


class GtsamDescent:
    """Any factors, by GTSAM."""

    def __init__(self, trusted: GraphData, loops: Edges) -> None:
        self.trusted, self.loops, self._dimension = trusted, loops, trusted.dimension
        self._builder = Builder(trusted)
        self._graph = self._builder.graph(robust=False)
        self._measured = co.gtsam_poses(co.from_matrices(loops.T, self._dimension))
        self._params = levenberg_marquardt_params(needs_qr(trusted))
        self._factor = gtsam.BetweenFactorPose3 if self._dimension == 3 else gtsam.BetweenFactorPose2
        self._in_full = [self._make(k, loops.information[k]) for k in range(len(loops.i))]

    def _make(self, k: int, information: Array) -> Any:
        model = noise_model("information", information, None, self._dimension)
        return self._factor(X(int(self.loops.i[k])), X(int(self.loops.j[k])), self._measured[k], model)

    def state(self, coordinates: Array) -> gtsam.Values:
        """See :class:`Descent`."""
        return self._builder.values(coordinates)

    def coordinates(self, state: gtsam.Values) -> Array:
        """See :class:`Descent`."""
        return poses_of(state, self._dimension)

    def trusted_chi2(self, state: gtsam.Values) -> float:
        """See :class:`Descent`."""
        return float(2 * self._graph.error(state))

    def linear(self, state: gtsam.Values) -> Linear:
        """See :class:`Descent`."""
        graph = gtsam.NonlinearFactorGraph()
        graph.push_back(self._graph)
        for factor in self._in_full:
            graph.add(factor)
        row, column, value = graph.linearize(state).sparseJacobian_()
        whole = csr_matrix((value, (row.astype(np.int64) - 1, column.astype(np.int64) - 1))).tocsc()
        jacobian, residual = whole[:, :-1].tocsr(), -whole[:, -1].toarray().ravel()  # GTSAM's right-hand side is -r
        rows_of_loops = len(self._in_full) * (6 if self._dimension == 3 else 3)
        return Linear(jacobian, residual, len(residual) - rows_of_loops)

    def solve(self, state: gtsam.Values, weights: Array, iterations: int) -> gtsam.Values:
        """See :class:`Descent`."""
        graph = gtsam.NonlinearFactorGraph()
        graph.push_back(self._graph)
        for k in np.flatnonzero(weights).tolist():
            weight = weights[k]
            graph.add(self._in_full[k] if weight == 1 else self._make(k, weight * self.loops.information[k]))
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
        self.trusted, self.loops = trusted, loops
        self._trusted, self._held = planar_edges(trusted), held_poses(trusted)
        ends = np.column_stack([loops.i, loops.j])
        self._as_edges = as_planar(ends, co.from_matrices(loops.T, 2), loops.information)
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

    def linear(self, state: Array) -> Linear:
        """See :class:`Descent`."""
        both = zip(self._trusted, self._as_edges, strict=True)
        edges = PlanarEdges(*(np.concatenate([trusted, loops], axis=-1) for trusted, loops in both))
        return Linear(*edges.whitened(state, self._held), 3 * len(self._trusted.i))

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
            some = zip(self._trusted, self._as_edges, strict=True)
            self._edges = PlanarEdges(*(np.concatenate([kept, more[..., active]], axis=-1) for kept, more in some))
            self._active, self._system = active, PlanarSystem(self._edges, self._held)
        return self._edges, self._system
