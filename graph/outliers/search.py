"""Searches for the correct loops: nearest ones first, or all at once."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from hybridlio.core.arrays import Array, Mask
from hybridlio.graph.base.truncated_squares import GRADUATION
from hybridlio.graph.outliers.loop_support import LoopSupport
from hybridlio.graph.outliers.weighted_solver import Found, WeightedSolver

_FIRST_REACH = 4  # edges: the shortest loops that odometry of a few steps cannot fold
_COARSE_GRADUATION = 3.0  # within a round, whose candidates start near their places; 1.4 takes three times longer
# χ² in units of the bound from which a round starts at most: of a loop whose odometry has drifted by a hundred times
# its stated noise. Higher starts only add steps at which no weight changes.
_LARGEST_CHI2 = 1e4
# The same where the map is rigid, so that correct loops are near the bound. A wrong loop that has a weight joins
# distant poses; 245 make a step on sphere2500 take ten times as long.
_LARGEST_IN_RIGID_MAP = 100.0
_SOURCES_AT_ONCE = 256  # rows of distances in memory: 100 MB for 50,000 poses


def all_at_once(solver: WeightedSolver, start: Any) -> Found:
    """Graduate over all loops together, from their joint solution, as the paper does."""
    candidates = np.ones(len(solver.loops.i), dtype=bool)
    values = solver.solve(start, candidates.astype(np.float64))
    return solver.found(*solver.graduate(values, candidates, solver.bound, GRADUATION))


def backbone_first(solver: WeightedSolver, start: Any, support: LoopSupport, backbone: Mask, growth: float) -> Found:
    """Take in the loops of a backbone as :func:`nearest_first` does, then all others that are near the rigid map.

    Near are those within the bound for the noise as stated, too: with noise that is stated far too large, correct loops
    of a part that few loops hold can be as far from the bound for the noise that loops show.

    Args:
        solver, start, support, growth: as of :func:`nearest_first`.
        backbone: ``(M,)`` loops that make the map rigid.
    """
    largest = max(_LARGEST_IN_RIGID_MAP, 1 / support.scale)
    return nearest_first(solver, start, replace(support, supported=backbone), growth, largest)


def nearest_first(
    solver: WeightedSolver, start: Any, support: LoopSupport, growth: float, largest: float = _LARGEST_CHI2
) -> Found:
    """Take in loops in rounds, those that span the fewest edges first, so that odometry has not drifted far.

    A round graduates over the loops so far and those whose ends are at most a number of edges apart, along odometry and
    the loops that count as correct; each round takes in loops of ``growth`` times as many. Loops that a neighbour
    confirms come first, all others when these have made the map rigid.

    Args:
        solver: of the graph.
        start: values along the odometry.
        support: what pairs of neighbouring loops say.
        growth: factor on the number of edges.
        largest: χ² from which a round of all loops starts at most, in units of the bound.
    """
    count, poses = len(solver.loops.i), len(solver.poses(start))
    values, correct, tried = start, np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
    mostly_confirmed = 2 * np.count_nonzero(support.supported) > count
    phases = [(support.supported, float(_FIRST_REACH)), (np.ones(count, dtype=bool), float(_FIRST_REACH))]
    if mostly_confirmed:
        phases[1] = phases[1][0], poses * growth  # the map is rigid: all at once
    for allowed, reach in phases:
        while not tried[allowed].all():
            near = _spans(solver, correct, reach) <= reach if reach < poses else np.ones(count, dtype=bool)
            candidates = correct | (near & (allowed | tried))
            if (candidates & ~tried).any():
                bound = solver.bound * support.scale
                first = largest if candidates.all() else _LARGEST_CHI2
                values, correct = solver.graduate(values, candidates, bound, _COARSE_GRADUATION, first)
                tried |= candidates
            reach *= growth
    return solver.found(values, correct)


def _spans(solver: WeightedSolver, correct: Mask, limit: float) -> Array:
    """Return the number of edges ``(M,)`` between the ends of each loop, infinite beyond the limit."""
    loops, odometry = solver.loops, solver.odometry
    i, j = np.concatenate([odometry.i, loops.i[correct]]), np.concatenate([odometry.j, loops.j[correct]])
    count = int(max(loops.i.max(), loops.j.max(), i.max(initial=0), j.max(initial=0))) + 1
    adjacency = coo_matrix((np.ones(len(i)), (i, j)), shape=(count, count)).tocsr()
    sources, row = np.unique(loops.i, return_inverse=True)
    spans = np.empty(len(loops.i))
    for first in range(0, len(sources), _SOURCES_AT_ONCE):
        some = sources[first : first + _SOURCES_AT_ONCE]
        distances = dijkstra(adjacency, directed=False, unweighted=True, indices=some, limit=limit)
        inside = (row >= first) & (row < first + len(some))
        spans[inside] = distances[row[inside] - first, loops.j[inside]]
    return spans
