"""Alternatives to a set of correct loops: clusters of loops taken as correct or as wrong, one at a time."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from hybridlio.core.arrays import Index, Mask
from hybridlio.graph.base.truncated_squares import GRADUATION
from hybridlio.graph.outliers.weighted_solver import Found, WeightedSolver, least

# Poses and loops that all graduations together may pass over: a few seconds, and in graphs of some hundred poses and
# loops every cluster.
_WORK = 10_000
_FEWEST = 3  # alternatives that are tried in the largest graphs
_HOLDING_ITERATIONS = 10  # loops that odometry contradicts need several, as a solution of a set does
_CONFIRMATIONS = 5  # searches that end at the best result, after which only rejected groups are tried


class Alternatives(NamedTuple):
    """What toggling found.

    Attributes:
        found: results of all searches.
        untried: masks ``(M,)`` of the groups of loops that the best result rejects, and that were not tried.
    """

    found: list[Found]
    untried: list[Mask]


class Move(NamedTuple):
    """A cluster of loops to take as correct or as wrong."""

    cluster: int
    correct: bool


def toggled(solver: WeightedSolver, start: Any, cluster: Index, found: list[Found]) -> Alternatives:
    """Search again with each cluster taken as correct, or as wrong, in the order of what the best result leaves open.

    Groups, clusters of several loops, that are rejected come first: wrong loops seldom confirm one another.

    Args:
        solver: of the graph.
        start: values along the odometry.
        cluster: ``(M,)`` cluster of each loop.
        found: results so far, at least one.
    """
    found, tried = list(found), set[Move]()
    left = max(_WORK // (solver.size + len(cluster)), _FEWEST)
    while True:
        best = least(found)
        groups = [move for move in _rejected_groups(best.correct, cluster) if move not in tried]
        if not left or not (groups or not _confirmed(best, found)):
            return Alternatives(found, [cluster == move.cluster for move in groups])
        moves = groups or [move for move in _other_moves(best.correct, cluster) if move not in tried]
        if not moves:
            return Alternatives(found, [])
        move = moves[0]
        tried.add(move)
        members = cluster == move.cluster
        if move.correct:  # from the best result; the start along the odometry leads elsewhere where it has drifted far
            with_it = solver.found(best.values, best.correct | members)
            if not np.array_equal(with_it.correct, best.correct):  # no confirmation: it started from there
                found.append(with_it)
        again = (_around if move.correct else _without)(solver, start, members, best.cost + solver.price)
        if again is not None:
            found.append(again)
            left -= 1


def _confirmed(best: Found, found: list[Found]) -> bool:
    return sum(np.array_equal(one.correct, best.correct) for one in found) > _CONFIRMATIONS


def _rejected_groups(correct: Mask, cluster: Index) -> list[Move]:
    """Return the clusters of two loops or more that are mostly rejected, largest first, to be taken as correct."""
    sizes, accepted = np.bincount(cluster), np.bincount(cluster, weights=correct)
    numbers = np.flatnonzero((sizes > 1) & (2 * accepted < sizes))
    return [Move(number, True) for number in numbers[np.argsort(-sizes[numbers], kind="stable")].tolist()]


def _other_moves(correct: Mask, cluster: Index) -> list[Move]:
    """Return rejected loops to be taken as correct, then accepted clusters to be taken as wrong, then to be kept.

    Keeping an accepted cluster in full from the start leads to other results than finding it does.
    """
    sizes, accepted = np.bincount(cluster), np.bincount(cluster, weights=correct)
    largest_first = np.argsort(-sizes, kind="stable")
    taken = largest_first[accepted[largest_first] > 0].tolist()
    single = np.flatnonzero((sizes == 1) & (accepted == 0)).tolist()
    return [*(Move(k, True) for k in single), *(Move(k, False) for k in taken), *(Move(k, True) for k in taken)]


def _around(solver: WeightedSolver, start: Any, cluster: Mask, limit: float) -> Found | None:
    """Graduate over all loops with some held at full weight, as if they were known to be correct.

    Args:
        solver: of the graph.
        start: values along the odometry.
        cluster: ``(M,)`` the loops that are held.
        limit: cost beyond which the result does not matter; the loops alone often exceed it, which ends the search.
    """
    values = solver.solve(start, cluster.astype(np.float64), _HOLDING_ITERATIONS)
    if solver.cost_with(values, cluster) > limit:
        return None
    candidates = np.ones(len(cluster), dtype=bool)
    return solver.found(*solver.graduate(values, candidates, solver.bound, GRADUATION, held=cluster))


def _without(solver: WeightedSolver, start: Any, cluster: Mask, limit: float) -> Found | None:
    """Graduate over all loops but some, as if they were known to be wrong; arguments as for :func:`_around`."""
    if np.count_nonzero(cluster) * solver.price > limit:
        return None
    values = solver.solve(start, (~cluster).astype(np.float64))
    return solver.found(*solver.graduate(values, ~cluster, solver.bound, GRADUATION))
