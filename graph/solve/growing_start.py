"""A start for graphs with landmarks, solved over more and more of the poses in their order.

Relaxation does not see landmarks. From odometry that has drifted by more than a landmark's distance, an optimiser over
all poses stops in a wrong minimum: on Victoria Park (6,969 poses, 151 landmarks) at 45 times the error of this start.
"""

from __future__ import annotations

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import GraphError
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.checks import check_determined
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.solve.builder import Builder
from hybridlio.graph.solve.nonlinear import NonlinearSolver
from hybridlio.graph.solve.settings import IterationProgress, silent

_FIRST_POSES = 50  # a stretch whose odometry has not drifted far
_GROWTH = (
    1.15  # of the poses from one solve to the next: 35 solves to 7,000 poses, together of 8 times the last one's size
)
_ITERATIONS, _TOLERANCE = 20, 1e-3  # each part is solved again with more poses
_GOOD_ERROR_PER_FREEDOM = 1.0  # twice what consistent factors have at the optimum, as for initial values


def grow_start(data: GraphData, start: Array, report: IterationProgress) -> Array:
    """Return a start at least as good as ``start``, where observations of landmarks do not fit it.

    Args:
        data: the graph.
        start: coordinates ``(N, 7)`` or ``(N, 3)``; its relative poses extend each solved part.
        report: called with the number of poses solved so far.
    """
    if not len(data.landmarks):
        return start
    builder = Builder(data)
    graph = builder.graph()
    before = float(graph.error(builder.values(start)))
    if before <= _GOOD_ERROR_PER_FREEDOM * _degrees_of_freedom(data):
        return start
    grown = _grow(data, co.to_matrices(start), report)
    return grown if float(graph.error(builder.values(grown))) < before else start


def _degrees_of_freedom(data: GraphData) -> int:
    others = sum(len(f.noise.values) for f in data.other_factors.values() if f.noise is not None)
    unknown = data.tangent_size * len(data) + data.dimension * len(data.landmarks)
    return max(data.tangent_size * len(data.edges) + others - unknown, 1)


def _grow(data: GraphData, T: Array, report: IterationProgress) -> Array:
    """Return coordinates of all poses, solved part by part from poses ``(N, 4, 4)``."""
    T, count, size = T.copy(), len(data), float(_FIRST_POSES)
    latest = _latest_pose(data)
    while size < count:
        n = int(size)
        size *= _GROWTH
        part = _first_poses(data, n, latest)
        part.set_all_initial(co.from_matrices(T[:n], data.dimension))
        try:
            check_determined(part)
            solve = NonlinearSolver(part, _ITERATIONS, _TOLERANCE, silent)
            solved = co.to_matrices(solve(part.initial_values).poses)
        except GraphError:  # the first poses are not determined by themselves
            continue
        T[n:] = se3.orthonormalise(solved[-1] @ se3.inverse(T[n - 1]) @ T[n:])
        T[:n] = solved
        report("growing", n, 0.0)
    return co.from_matrices(T, data.dimension)


def _latest_pose(data: GraphData) -> dict[int, int]:
    """Return the index of the latest pose of each factor but between-factors, by id."""
    return {n: max(data.index[key] for key in factor.keys) for n, factor in data.other_factors.items()}


def _first_poses(data: GraphData, count: int, latest: dict[int, int]) -> GraphData:
    """Return the graph of the first poses, and of the factors that concern them alone."""
    part = GraphData(data.dimension)
    keys = data.keys[:count]
    part.add_poses(keys, data.initial_values[:count])
    part.landmarks = data.landmarks.copy()
    for key in data.fixed & set(keys):
        part.fix(key)
    part.edges = data.edges.where(np.asarray(data.edges.ends.max(axis=1, initial=0) < count))
    part.other_factors = {n: factor for n, factor in data.other_factors.items() if latest[n] < count}
    return part
