"""Joins of two runs: pairs of scans, one of each run, at one place."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hybridlio.core.arrays import Array, Index
from hybridlio.localization.run_places import RunPlaces
from hybridlio.smoothing.loop_closure import mutually_consistent
from hybridlio.smoothing.loop_consistency import ConsistencySettings
from hybridlio.smoothing.loops import Loop
from hybridlio.smoothing.step_uncertainty import OdometryChain

# Joins that agree, fewer of which join no runs, and the path that they must span: as a start in a map is confirmed.
_LEAST, _LEAST_SPAN_M = 3, 8.0


@dataclass(frozen=True, eq=False)
class RunJoin:
    """How two runs join.

    Attributes:
        earlier, later: numbers of the runs.
        joins: pairs of scans; ``earlier`` is a row of the one run, ``later`` of the other.
        rejected: number of verified pairs that contradict these, or too few to be believed.
    """

    earlier: int
    later: int
    joins: tuple[Loop, ...]
    rejected: int


class _TwoChains:
    """The odometry of two runs as one; rows of the second follow those of the first. Each call is about one run."""

    def __init__(self, first: OdometryChain, second: OdometryChain) -> None:
        self._chains, self._rows = (first, second), len(first.poses)
        self.travelled_m: Array = np.concatenate([first.travelled_m, second.travelled_m])

    def relative(self, i: Index, j: Index) -> Array:
        chain, offset = self._chain(i)
        return chain.relative(i - offset, j - offset)

    def covariance(self, i: Index, j: Index) -> Array:
        chain, offset = self._chain(i)
        return chain.covariance(i - offset, j - offset)

    def _chain(self, i: Index) -> tuple[OdometryChain, int]:
        return (self._chains[1], self._rows) if i[0] >= self._rows else (self._chains[0], 0)


def join_runs(runs: tuple[RunPlaces, RunPlaces], numbers: tuple[int, int]) -> RunJoin:
    """Find the joins of two runs; none if they share no place.

    Each keyframe of the second run is recognised among those of the first. Of the verified pairs the largest set that
    agrees with both odometries is kept (Mangelson et al. 2018, :mod:`hybridlio.smoothing.loop_consistency`).

    Args:
        runs: the two.
        numbers: of the runs.
    """
    first, second = runs
    rows, later_rows = first.keyframes.rows, second.keyframes.rows
    found = [
        Loop(
            int(rows[one.place]), int(later_rows[k]), one.verdict.pose, one.verdict.covariance, one.verdict.matched,
            one.verdict.cost,
        )
        for k in range(len(later_rows))
        for one in first.map_places.recognise(second.map_places.places, k)
    ]  # fmt: skip
    offset = len(first.trajectory)
    shifted = [replace(one, later=one.later + offset) for one in found]
    kept, _ = mutually_consistent(shifted, _TwoChains(first.chain, second.chain), ConsistencySettings())
    joins = tuple(replace(one, later=one.later - offset) for one in kept)
    if not _enough(joins, second.chain):
        joins = ()
    return RunJoin(*numbers, joins, len(found) - len(joins))


def _enough(joins: tuple[Loop, ...], later: OdometryChain) -> bool:
    travelled = later.travelled_m[sorted({one.later for one in joins})]
    return len(travelled) >= _LEAST and float(np.ptp(travelled)) >= _LEAST_SPAN_M
