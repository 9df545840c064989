"""Improving a set of correct loops by what some of them would change: left out, if accepted, or taken in, if not.

In a linear model the total χ² falls by ``rᵀ (I − J P Jᵀ)⁻¹ r`` where a measurement is left out, and rises by
``rᵀ (I + J P Jᵀ)⁻¹ r`` where one is taken in, with its whitened residual ``r``, Jacobian ``J`` and the covariance ``P``
of the solution. The first is the χ² of its deleted residual, the test of Baarda's data snooping ("A testing procedure
for use in geodetic networks", 1968). A wrong loop that bends the map has a small residual and a large deleted one.
"""

from __future__ import annotations

import numpy as np

from hybridlio.core.arrays import Index, Mask
from hybridlio.graph.outliers.linear_changes import LinearChanges
from hybridlio.graph.outliers.weighted_solver import FAR_OFF, LARGEST_GROUP, Found, WeightedSolver, least

_ROUNDS = 5  # of improvements: each lowers the cost; one or two suffice where any does
_GAIN = 0.01  # of the price: less is a descent that went on, or a loop at the bound
_TRIED = 3  # exchanges of a round that are solved, those that promise most
_RESISTING = 3  # loops, and clusters, without which a group is tested
_NEAR = 2.0  # factor on the price within which an exchange is of interest though it costs more, to first order


def exchanged(solver: WeightedSolver, cluster: Index, best: Found, margin: float) -> list[Found]:
    """Return results that differ from the best one by few loops, and cost less or hardly more, to first order.

    Args:
        solver: of the graph.
        cluster: ``(M,)`` cluster of each loop.
        best: the result to improve.
        margin: cost by which another result may exceed the best one, and still be of interest.
    """
    found: list[Found] = []
    for _ in range(_ROUNDS):
        tried = [solver.found(best.values, best.correct ^ some) for some in _promising(solver, cluster, best, margin)]
        # the same loops again are no confirmation: the search started from there
        found += [one for one in tried if not np.array_equal(one.correct, best.correct)]
        better = least([best, *found])
        if not better.cost < best.cost - _GAIN * solver.price:
            break
        best = better
    return found


def _changes_at(solver: WeightedSolver, best: Found, chosen: Mask | None = None) -> LinearChanges | None:
    """Return what exchanges change at a result; None where loops with a trace of weight alone determine some pose."""
    try:
        return LinearChanges(solver.linear(best.values), best.correct, solver.price, chosen)
    except RuntimeError:  # singular
        return None


def _promising(solver: WeightedSolver, cluster: Index, best: Found, margin: float) -> list[Mask]:
    """Return sets of loops ``(M,)`` to exchange, those that lower the cost most first."""
    changes = _changes_at(solver, best)
    if changes is None:
        return []
    single = changes.single
    wrong, missed = best.correct & (single > solver.price), ~best.correct & (single < solver.price)
    sets = [some for some in (wrong, missed) if np.count_nonzero(some) > 1]
    near = np.where(best.correct, single > solver.price / _NEAR, single < solver.price * _NEAR)
    sets += [np.arange(len(cluster)) == k for k in np.flatnonzero(near)]
    sizes, accepted = np.bincount(cluster), np.bincount(cluster, weights=best.correct)
    whole = (sizes > 1) & (sizes <= LARGEST_GROUP) & (sizes == accepted)
    sets += [cluster == number for number in np.flatnonzero(whole)]
    before = solver.cost_of_rejecting(~best.correct)
    exchanges = [_followed(changes, best.correct, some, solver.price) for some in sets]
    costs = [
        change + solver.cost_of_rejecting(~best.correct ^ some) - before
        for some, (change, _) in zip(sets, exchanges, strict=True)
    ]
    promising = [k for k in np.argsort(costs, kind="stable")[:_TRIED].tolist() if costs[k] < margin]
    followed = [sets[k] | exchanges[k][1] for k in promising if exchanges[k][1].any()]
    return [*(sets[k] for k in promising), *followed]


def _followed(changes: LinearChanges, correct: Mask, some: Mask, price: float) -> tuple[float, Mask]:
    """Return the change of χ² and prices where some loops change sides and others follow, and these ``(M,)``.

    Others follow where that lowers the cost; each counts as if it were the only one.
    """
    change, single = changes.exchange(some)
    gains = np.nan_to_num(np.where(correct, single - price, price - single))
    followers = ~some & (gains > 0)
    return change - float(gains[followers].sum()), followers


def is_sure(solver: WeightedSolver, cluster: Index, best: Found) -> bool:
    """Whether no rejected loop or cluster comes near to paying for itself where it is taken in, to first order.

    Taking in a cluster costs at least what its worst loop alone costs. That no other map is possible follows only where
    the accepted loops are known to be correct.

    Args:
        solver: of the graph.
        cluster: ``(M,)`` cluster of each loop.
        best: the result.
    """
    rejected = np.flatnonzero(~best.correct)
    if not len(rejected):
        return True
    by_chi2 = rejected[np.argsort(-solver.chi2(best.values)[rejected], kind="stable")]
    numbers, first = np.unique(cluster[by_chi2], return_index=True)
    worst = by_chi2[first]  # of each cluster
    changes = _changes_at(solver, best, np.isin(np.arange(len(cluster)), worst))
    if changes is None:
        return False
    prices = [solver.cost_of_rejecting(~best.correct & (cluster == number)) for number in numbers]
    return bool((changes.single[worst] > _NEAR * np.array(prices)).all())  # unknown ones are NaN


def contradicted(solver: WeightedSolver, cluster: Index, best: Found, groups: list[Mask]) -> bool:
    """Whether the result contradicts each of some rejected groups, to first order, also without what resists it most.

    What resists a group are the accepted loops and clusters whose residuals it raises most. Taking in a group saves the
    price of its rejection, which pays for few of them.

    Args:
        solver: of the graph.
        cluster: ``(M,)`` cluster of each loop.
        best: the result.
        groups: masks ``(M,)``.
    """
    changes = _changes_at(solver, best)
    if changes is None:
        return False
    return all(_contradicts(changes, solver, cluster, best.correct, group) for group in groups)


def _contradicts(changes: LinearChanges, solver: WeightedSolver, cluster: Index, correct: Mask, group: Mask) -> bool:
    enough = FAR_OFF * solver.cost_of_rejecting(group)
    _, after = changes.exchange(group)
    if not np.isfinite(after[correct]).all():  # the work did not suffice
        return False
    stress = np.where(correct, after, 0.0)
    loops = [np.arange(len(cluster)) == k for k in np.argsort(-stress)[:_RESISTING]]
    clusters = [correct & (cluster == k) for k in np.argsort(-np.bincount(cluster, stress))[:_RESISTING]]
    small = [some for some in clusters if 1 < np.count_nonzero(some) <= LARGEST_GROUP]
    for resisting in [np.zeros_like(group), *loops, *small]:
        change, single = changes.exchange(group | resisting)
        joining = np.maximum(solver.price - single[~(correct | group)], 0)  # rejected loops that would fit then
        if not change - float(np.nansum(joining)) > enough:
            return False
    return True
