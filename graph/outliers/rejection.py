"""Rejection of wrong loop closures: the set of loops of least truncated cost that several searches find.

The cost is that of graduated non-convexity with truncated least squares (Yang, Antonante, Tzoumas, Carlone, "Graduated
non-convexity for robust spatial perception", RA-L 2020, section IV). From one start graduation often ends in a wrong
minimum: where odometry has drifted far, correct loops look as wrong as wrong ones. So loops that confirm one another
come first (Mangelson et al., "Pairwise consistent measurement set maximization", ICRA 2018; here among neighbours
alone), those that span the fewest edges before the others. The searches run on a graph whose unbranched odometry is
condensed, ten to fifty times faster where loops are few, which leaves time for alternatives: each cluster of loops
taken as correct or as wrong. Loops that confirm one another are not independent, so that rejecting a whole cluster
costs less than rejecting as many single loops: otherwise a few wrong loops that agree outweigh the correct ones of a
map that has few. Where pairs of loops show that all noise is stated too large, results are compared at the noise that
they show. An alternative with another map that costs hardly more makes the result doubtful.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from hybridlio.core.arrays import Array, Mask
from hybridlio.core.chi_square import chi_square_quantile
from hybridlio.core.errors import GraphError
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.edge_arrays import edges_of
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.outliers.condensed import condense
from hybridlio.graph.outliers.descents import descent
from hybridlio.graph.outliers.exchange import contradicted, exchanged, is_sure
from hybridlio.graph.outliers.loop_support import GraphOdometry, LoopSupport, loop_support
from hybridlio.graph.outliers.search import all_at_once, backbone_first, nearest_first
from hybridlio.graph.outliers.toggling import Alternatives, toggled
from hybridlio.graph.outliers.weighted_solver import LARGEST_GROUP, Found, WeightedSolver, least, undominated
from hybridlio.graph.solve.initial_values import find_initial_values
from hybridlio.graph.solve.settings import IterationProgress

# Chance that even one of all correct loops exceeds the bound. The usual bound of 1 % a loop rejects many of a large
# graph's, and its poses then move by more than their standard deviations.
_CHANCE_OF_A_LOSS = 0.1
_GROWTHS = 3.0, 2.0, 1.5  # of the rounds of the searches: the finer, the more of them
_SAME_MAP = 0.01  # of the spread of positions, up to which two maps count as one: what benchmarks count as right
# Difference of χ² within which another map makes the result doubtful: a twentieth of the best
# map's likelihood.
_RIVAL = 2 * np.log(20)
_RESTING_ITERATIONS = 50  # before two maps are compared; MIT's needs tens
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
    edges = edges_of(data)
    loops, odometry = edges.where(~edges.consecutive), edges.where(edges.consecutive)
    if not len(loops.i):
        return Rejection(start, frozenset())
    trusted, bound = data.copy(without=loops.ids.tolist()), loop_bound(data.tangent_size, len(loops.i))
    if along is None:
        whole = WeightedSolver(descent(trusted, loops), odometry, bound, report)
        best = all_at_once(whole, whole.values(start))
        return _rejection(
            whole, best, ("odometry does not reach every pose, so loops that join parts are not checked",)
        )
    chain = GraphOdometry(data, odometry, co.to_matrices(along))
    support = loop_support(loops, chain, bound)
    whole = WeightedSolver(descent(trusted, loops), odometry, bound, report, support)
    small = condense(trusted, loops, odometry, chain)
    solver = WeightedSolver(descent(small.trusted, small.loops), small.odometry, bound, report, support)
    found, untried = _search(solver, solver.values(start[small.kept]), support)
    best = least(found)
    doubts = _doubts(solver, found, support, untried)
    values = whole.values(small.expand(solver.coordinates(best.values)))
    return _rejection(whole, whole.found(values, best.correct), doubts)


def _rejection(solver: WeightedSolver, best: Found, doubts: tuple[str, ...]) -> Rejection:
    wrong = frozenset(solver.loops.ids[~best.correct].tolist())
    rejected = float(np.mean(~best.correct))
    if rejected > 0.5:
        doubts = (*doubts, f"{100 * rejected:.0f} % of the loops are rejected")
    return Rejection(solver.coordinates(best.values), wrong, doubts)


def odometry_start(data: GraphData) -> Array | None:
    """Return coordinates along the odometry, which no wrong loop spoils, or None where it does not reach every pose."""
    try:
        return find_initial_values(data, "odometry")
    except GraphError:
        return None


def _search(solver: WeightedSolver, start: Any, support: LoopSupport) -> Alternatives:
    """Return the sets of correct loops that the searches find.

    Where most loops belong to clusters that are too large to be wrong, and these make a map that contradicts every
    rejected loop, one search is enough.
    """
    found: list[Found] = []
    backbone = _backbone(support)
    if backbone is not None:
        found.append(backbone_first(solver, start, support, backbone, _GROWTHS[0]))
        found += exchanged(solver, support.cluster, found[0], _rival_cost(solver))
        best = least(found)
        if best.correct[backbone].mean() > 1 - _SAME_SHARE and is_sure(solver, support.cluster, best):
            return Alternatives(found, [])
    found += [all_at_once(solver, start), nearest_first(solver, start, support, _GROWTHS[0])]
    as_stated = LoopSupport(1.0, np.zeros_like(support.supported), support.cluster)
    further = (as_stated, _GROWTHS[1]), (support, _GROWTHS[1]), (support, _GROWTHS[2])  # the most different ones first
    for used, growth in further:
        if _agreed(found):
            break
        found.append(nearest_first(solver, start, used, growth))
    margin = _rival_cost(solver)
    found += exchanged(solver, support.cluster, least(found), margin)
    before = least(found)
    found, untried = toggled(solver, start, support.cluster, found)
    if not np.array_equal(least(found).correct, before.correct):
        found += exchanged(solver, support.cluster, least(found), margin)
    return Alternatives(found, untried)


def _backbone(support: LoopSupport) -> Mask | None:
    """Return the loops ``(M,)`` of clusters that are too large to be wrong, if they are most of all loops."""
    sizes = np.bincount(support.cluster)
    backbone = sizes[support.cluster] > LARGEST_GROUP
    return backbone if backbone.mean() > 0.5 else None


def _agreed(found: list[Found]) -> bool:
    """Whether the two searches of least cost found the same loops."""
    best, second = sorted(found, key=lambda one: one.cost)[:2]
    return bool(np.mean(best.correct != second.correct) <= _SAME_SHARE)


def _doubts(solver: WeightedSolver, found: list[Found], support: LoopSupport, untried: list[Mask]) -> tuple[str, ...]:
    best, doubts = least(found), []
    if _rivals(solver, found, best):
        doubts.append("another set of loops, with another map, fits nearly as well")
    if untried and not contradicted(solver, support.cluster, best, untried):
        doubts.append("not every group of rejected loops that confirm one another was tried")
    confirmed = support.supported
    if confirmed.any() and np.mean(~best.correct[confirmed]) > 0.5:
        doubts.append("most loops that confirm one another are rejected")
    return tuple(doubts)


def _rivals(solver: WeightedSolver, found: list[Found], best: Found) -> list[Found]:
    """Return results with other loops and another map that cost hardly more; both maps are solved to the end first."""
    most = best.cost + _rival_cost(solver)
    sets = {one.correct.tobytes(): one for one in undominated(found) if one.cost < most}
    del sets[best.correct.tobytes()]
    if not sets:
        return []
    poses = solver.poses(_at_rest(solver, best))
    return [one for one in sets.values() if _other_map(poses, solver.poses(_at_rest(solver, one)))]


def _rival_cost(solver: WeightedSolver) -> float:
    """Return the cost by which a rival exceeds the best result at most, at the noise that loops show."""
    return float(_RIVAL * solver.price / solver.bound)


def _at_rest(solver: WeightedSolver, one: Found) -> Any:
    return solver.solve(one.values, one.correct.astype(np.float64), _RESTING_ITERATIONS)


def _other_map(poses: Array, others: Array) -> bool:
    """Whether the positions of poses ``(N, 4, 4)`` differ by more than a hundredth of their spread."""
    a, b = poses[:, :3, 3], others[:, :3, 3]
    spread = np.sqrt(((a - a.mean(axis=0)) ** 2).sum(axis=1).mean())
    return bool(np.sqrt(((a - b) ** 2).sum(axis=1).mean()) > _SAME_MAP * spread)
