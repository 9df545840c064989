"""Rejection of wrong loop closures: the set of loops of least truncated cost that several searches find.

The cost is that of graduated non-convexity with truncated least squares (Yang, Antonante, Tzoumas, Carlone, "Graduated
non-convexity for robust spatial perception", RA-L 2020, section IV). From one start graduation often ends in a wrong
minimum: where odometry has drifted far, correct loops look as wrong as wrong ones. So loops that confirm one another
come first (Mangelson et al., "Pairwise consistent measurement set maximization", ICRA 2018; here among neighbours
alone), those that span the fewest edges before the others, and searches are repeated until two agree.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import gtsam
import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.core.chi_square import chi_square_quantile
from hybridlio.core.errors import GraphError
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.edge_arrays import loops_of
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.outliers.loop_support import GraphOdometry, LoopSupport, loop_support
from hybridlio.graph.outliers.search import Found, all_at_once, nearest_first, repaired
from hybridlio.graph.outliers.weighted_solver import WeightedSolver
from hybridlio.graph.solve.initial_values import find_initial_values
from hybridlio.graph.solve.linear_solver import poses_of
from hybridlio.graph.solve.settings import IterationProgress

# Chance that even one of all correct loops exceeds the bound. The usual bound of 1 % a loop rejects many of a large
# graph's, and its poses then move by more than their standard deviations.
_CHANCE_OF_A_LOSS = 0.1
_GROWTHS = 3.0, 2.0, 1.5  # of the rounds of the searches: the finer, the more of them
_LOST_SHARE = 0.05  # of confirmed loops whose rejection asks for a second look: few wrong loops agree with a neighbour
_SAME_SHARE = 0.01  # of loops on which two searches may differ and still agree: some lie at the bound


class Rejection(NamedTuple):
    """What rejection found.

    Attributes:
        start: coordinates ``(N, 7)`` or ``(N, 3)`` of all poses, solved without the wrong loops.
        wrong: ids of the wrong loops.
        doubts: why the result may be wrong; empty where nothing speaks against it.
    """

    start: Array
    wrong: frozenset[int]
    doubts: tuple[str, ...] = ()


def loop_bound(size: int, count: int) -> float:
    """Return the χ² of ``size`` degrees of freedom that all of ``count`` correct loops stay below nine times in ten."""
    return chi_square_quantile((1 - _CHANCE_OF_A_LOSS) ** (1 / count), size)


def reject_outliers(data: GraphData, start: Array | None, report: IterationProgress) -> Rejection:
    """Find the wrong loop closures and solve without them.

    Only between-factors of keys that are not consecutive may be wrong; all others are trusted.

    Args:
        data: the graph; its robust kernels are not used.
        start: coordinates ``(N, 7)`` or ``(N, 3)`` to start from, or None: then along the odometry, which no wrong
            loop spoils, or by chordal relaxation where odometry does not reach every pose.
        report: called with the sum of truncated χ² of the loops.

    Raises:
        GraphError: the graph cannot be solved.
    """
    along = odometry_start(data)
    start = along if start is None else start
    start = find_initial_values(data, "chordal") if start is None else start
    count = len(loops_of(data))
    if not count:
        return Rejection(start, frozenset())
    solver = WeightedSolver(data, loop_bound(data.tangent_size, count), report)
    first = solver.values(start)
    support = _support(data, solver, along)
    found = [search() for search in _first_searches(solver, first, support)]
    for search in _more_searches(solver, first, support):
        if _agreed(found):
            break
        found.append(search())
    best = min(found, key=lambda one: one.cost)
    if not _agreed(found) or _lost_support(best, support) > _LOST_SHARE:
        best = repaired(solver, best)
    wrong = frozenset(solver.loops.ids[~best.correct].tolist())
    poses = poses_of(best.values, data.dimension)
    return Rejection(poses, wrong, _doubts(best, found, support, along is not None))


def odometry_start(data: GraphData) -> Array | None:
    """Return coordinates along the odometry, which no wrong loop spoils, or None where it does not reach every pose."""
    try:
        return find_initial_values(data, "odometry")
    except GraphError:
        return None


_Search = Callable[[], Found]


def _support(data: GraphData, solver: WeightedSolver, along: Array | None) -> LoopSupport | None:
    if along is None:
        return None
    return loop_support(solver.loops, GraphOdometry(data, solver.odometry, co.to_matrices(along)), solver.bound)


def _first_searches(solver: WeightedSolver, start: gtsam.Values, support: LoopSupport | None) -> Iterator[_Search]:
    yield lambda: all_at_once(solver, start)
    if support is not None:
        yield lambda: nearest_first(solver, start, support, _GROWTHS[0])


def _more_searches(solver: WeightedSolver, start: gtsam.Values, support: LoopSupport | None) -> Iterator[_Search]:
    """Yield further searches, the most different ones first."""
    if support is None:
        return
    as_stated = LoopSupport(1.0, np.zeros_like(support.supported))  # noise as stated, and no loop before the others
    yield lambda: nearest_first(solver, start, as_stated, _GROWTHS[1])
    yield lambda: nearest_first(solver, start, support, _GROWTHS[1])
    yield lambda: nearest_first(solver, start, support, _GROWTHS[2])


def _agreed(found: list[Found]) -> bool:
    """Whether the two searches of least cost found the same loops."""
    if len(found) < 2:
        return True
    best, second = sorted(found, key=lambda one: one.cost)[:2]
    return bool(np.mean(best.correct != second.correct) <= _SAME_SHARE)


def _lost_support(best: Found, support: LoopSupport | None) -> float:
    """Return the share of the loops confirmed by a neighbour that are rejected."""
    if support is None or not support.supported.any():
        return 0.0
    return float(np.mean(~best.correct[support.supported]))


def _doubts(best: Found, found: list[Found], support: LoopSupport | None, reached: bool) -> tuple[str, ...]:
    doubts = []
    if not reached:
        doubts.append("odometry does not reach every pose, so loops that join parts cannot be checked")
    if not _agreed(found):
        doubts.append(f"no two of {len(found)} searches for the wrong loops agree")
    rejected = np.mean(~best.correct)
    if rejected > 0.5:
        doubts.append(f"{100 * rejected:.0f} % of the loops are rejected")
    if _lost_support(best, support) > 0.5:
        doubts.append("most loops that confirm one another are rejected")
    return tuple(doubts)
