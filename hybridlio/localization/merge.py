"""Merge runs: sessions or robots in one place, joined by place recognition into one graph and one world."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import ConfigError
from hybridlio.core.progress import Progress
from hybridlio.core.trajectory import Trajectory
from hybridlio.graph.base.deep_stack import on_deep_stack
from hybridlio.graph.formats.files import write_graph
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.model.new_factors import between_factor, prior_factor
from hybridlio.graph.model.noise import NoiseInput
from hybridlio.graph.solve.batch import solve_batch
from hybridlio.graph.solve.settings import Settings, silent
from hybridlio.graph.solve.solution import Solution
from hybridlio.localization.joins import RunJoin, join_runs
from hybridlio.localization.run_places import RunPlaces
from hybridlio.record.record import Record
from hybridlio.smoothing.loop_closure import find_loops
from hybridlio.smoothing.loops import Loop

_FIRST_SIGMA = 1e-6  # rad, m: the first pose of the first run is the world; a covariance must be positive definite
# From the last keyframe of one run to the first of the next, rad and m. GNC checks loops against a chain through all
# poses; this link completes it, and is so vague that it weighs nothing beside a join (0.01 m).
_BETWEEN_RUNS = (1.0, 1.0, 1.0, 10.0, 10.0, 10.0)
_MAX_ITERATIONS, _TOLERANCE = 100, 1e-6  # as of PoseGraph.optimize
_KEPT_WEIGHT = 0.5  # a join of this weight counts; GNC's weights are 0 or 1


@dataclass(frozen=True, eq=False)
class Merged:
    """Runs in one world.

    Attributes:
        trajectories: of each run in the world of the first, with covariances relative to the first run's first pose;
            None for a run that could not be joined.
        joins: the joins of each pair of runs that count in the solved graph.
        solution: of the graph of the keyframes of all joined runs, numbered through.
        first_keys: of each run, the key of its first keyframe; None for a run that could not be joined.
    """

    trajectories: tuple[Trajectory | None, ...]
    joins: tuple[RunJoin, ...]
    loops: tuple[tuple[Loop, ...], ...]
    solution: Solution
    first_keys: tuple[int | None, ...]
    _graph: GraphData

    @property
    def unjoined(self) -> list[int]:
        """Numbers of the runs that could not be joined."""
        return [n for n, one in enumerate(self.trajectories) if one is None]

    def save_graph(self, path: Path) -> None:
        """Write the graph with the solution's poses, as :meth:`hybridlio.graph.PoseGraph.save` does."""
        write_graph(self._graph, path, self.solution)

    def to_json_dict(self) -> dict[str, Any]:
        """Return the joins of each pair, the loops of each run, and the runs that are not joined."""
        pairs = [
            {"runs": [one.earlier, one.later], "joins": len(one.joins), "rejected": one.rejected} for one in self.joins
        ]
        return {"pairs": pairs, "loops": [len(loops) for loops in self.loops], "unjoined": self.unjoined}


def merge(
    records: Sequence[Record], trajectories: Sequence[Trajectory] | None = None, progress: Progress | None = None
) -> Merged:
    """Join runs by the places that they share, and optimise them together.

    Every pair of runs is searched for joins, and every run for loops of its own. Those that agree enter one graph with
    the odometry of all runs, in which graduated non-convexity rejects wrong ones. A run that no join reaches stays out,
    and is said.

    Args:
        records: of the runs, with keyframes; the first one's first scan is the world.
        trajectories: their poses, such as smoothed ones; by default those of the records.
        progress: called with the stage, pairs of runs, or keyframes of a run, done and in all.

    Raises:
        ConfigError: fewer than two runs.
        DataError: a record has no keyframes.
        GraphError: the graph cannot be solved.
    """
    if len(records) < 2:
        raise ConfigError(f"merging needs two runs or more, got {len(records)}")
    given = trajectories or [record.online for record in records]
    runs = [RunPlaces.of(record, one) for record, one in zip(records, given, strict=True)]
    pairs = list(combinations(range(len(runs)), 2))
    found = []
    for done, (a, b) in enumerate(pairs, 1):
        found.append(join_runs((runs[a], runs[b]), (a, b)))
        if progress is not None:
            progress("joining", done, len(pairs))
    worlds = _worlds(runs, found)
    keys = _first_keys(runs, worlds)
    graph, ids = _graph(runs, found, worlds, keys)
    loops = {n: find_loops(replace(records[n], online=runs[n].trajectory), None, progress).loops for n in worlds}
    loop_ids = {n: [_add_loop(graph, runs[n], keys[n], one) for one in of_run] for n, of_run in loops.items()}
    settings = Settings("gnc", "given", _MAX_ITERATIONS, _TOLERANCE, lag=1)  # gnc has no lag
    solution = on_deep_stack(len(graph), lambda: solve_batch(graph, settings, silent))
    kept = [_kept(one, ids.get(n, []), solution) for n, one in enumerate(found)]
    still = _worlds(runs, kept)
    placed = [_trajectory(run, keys[n], solution) if n in still else None for n, run in enumerate(runs)]
    closed = tuple(
        tuple(one for one, i in zip(loops.get(n, ()), loop_ids.get(n, []), strict=True) if _counts(solution, i))
        for n in range(len(runs))
    )
    first_keys = tuple(keys.get(n) for n in range(len(runs)))
    return Merged(tuple(placed), tuple(kept), closed, solution, first_keys, graph)


def _worlds(runs: Sequence[RunPlaces], joins: Sequence[RunJoin]) -> dict[int, Array]:
    """Return the runs that joins lead to from the first one, in ascending order, and about where their worlds are.

    Returns:
        ``T_world_run`` ``(4, 4)`` by number, from the pairs with most joins; identity for the first run.
    """
    worlds: dict[int, Array] = {0: np.eye(4)}
    while new := [one for one in joins if one.joins and (one.earlier in worlds) != (one.later in worlds)]:
        strongest = max(new, key=lambda one: len(one.joins))
        middle = strongest.joins[len(strongest.joins) // 2]
        earlier, later = (runs[n].trajectory.poses for n in (strongest.earlier, strongest.later))
        T_earlier_later = earlier[middle.earlier] @ middle.pose @ se3.inverse(later[middle.later])
        if strongest.earlier in worlds:
            worlds[strongest.later] = worlds[strongest.earlier] @ T_earlier_later
        else:
            worlds[strongest.earlier] = worlds[strongest.later] @ se3.inverse(T_earlier_later)
    return dict(sorted(worlds.items()))


def _first_keys(runs: Sequence[RunPlaces], numbers: Iterable[int]) -> dict[int, int]:
    """Return the key of the first keyframe of some runs, whose keyframes are numbered through."""
    keys, key = {}, 0
    for n in numbers:
        keys[n] = key
        key += len(runs[n].keyframes)
    return keys


def _graph(
    runs: Sequence[RunPlaces], found: Sequence[RunJoin], worlds: dict[int, Array], keys: dict[int, int]
) -> tuple[GraphData, dict[int, list[int]]]:
    """Return the graph of the keyframes of all runs that are reached, and the factors of each pair's joins."""
    graph = GraphData()
    for n, world in worlds.items():
        _add_run(graph, runs[n], keys[n], world)
    first = NoiseInput(sigmas=(_FIRST_SIGMA,) * 6)
    graph.add_factor(prior_factor(graph, 0, runs[0].map_places.poses[0], first, None))
    for a, b in pairwise(worlds):
        T = se3.between(worlds[a] @ runs[a].map_places.poses[-1], worlds[b] @ runs[b].map_places.poses[0])
        graph.add_factor(between_factor(graph, (keys[b] - 1, keys[b]), T, NoiseInput(sigmas=_BETWEEN_RUNS), None))
    ids: dict[int, list[int]] = {}
    for n, pair in enumerate(found):
        if pair.earlier in worlds and pair.later in worlds:
            ids[n] = [
                _add_between(
                    graph,
                    keys[pair.earlier] + _number(runs[pair.earlier], one.earlier),
                    keys[pair.later] + _number(runs[pair.later], one.later),
                    one.pose,
                    one.covariance,
                )
                for one in pair.joins
            ]
    return graph, ids


def _add_run(graph: GraphData, run: RunPlaces, key: int, world: Array) -> None:
    """Add a run's keyframes, from a key on, and the odometry between them."""
    rows = run.keyframes.rows
    steps, covariances = run.chain.relative(rows[:-1], rows[1:]), run.chain.covariance(rows[:-1], rows[1:])
    poses = se3.orthonormalise(world @ run.map_places.poses)
    graph.add_poses(range(key, key + len(poses)), co.from_matrices(poses, 3))
    for k, (step, covariance) in enumerate(zip(steps, covariances, strict=True)):
        _add_between(graph, key + k, key + k + 1, step, covariance)


def _add_between(graph: GraphData, i: int, j: int, T_i_j: Array, covariance: Array) -> int:
    return graph.add_factor(between_factor(graph, (i, j), T_i_j, NoiseInput(covariance), None))


def _add_loop(graph: GraphData, run: RunPlaces, key: int, loop: Loop) -> int:
    i, j = (key + _number(run, row) for row in (loop.earlier, loop.later))
    return _add_between(graph, i, j, loop.pose, loop.covariance)


def _number(run: RunPlaces, row: int) -> int:
    """Return the number of the keyframe at a row."""
    return int(np.searchsorted(run.keyframes.rows, row))


def _kept(join: RunJoin, ids: list[int], solution: Solution) -> RunJoin:
    """Return the joins of a pair that the solution did not reject."""
    good = tuple(one for one, i in zip(join.joins, ids, strict=False) if _counts(solution, i))
    return replace(join, joins=good, rejected=join.rejected + len(join.joins) - len(good))


def _counts(solution: Solution, factor_id: int) -> bool:
    return solution.weight(factor_id) >= _KEPT_WEIGHT


def _trajectory(run: RunPlaces, key: int, solution: Solution) -> Trajectory:
    """Return all scans' poses in the common world: the odometry between the keyframes before and after each."""
    rows, count = run.keyframes.rows, len(run.trajectory)
    nodes = np.array([solution.pose(key + k) for k in range(len(rows))])
    node_covariances = np.array([solution.covariance(key + k) for k in range(len(rows))])
    scans = np.arange(count)
    after = np.clip(np.searchsorted(rows, scans), 0, len(rows) - 1)
    before = np.clip(np.searchsorted(rows, scans, side="right") - 1, 0, len(rows) - 1)
    from_before = nodes[before] @ run.chain.relative(rows[before], scans)
    from_after = nodes[after] @ run.chain.relative(rows[after], scans)
    gap = np.maximum(rows[after] - rows[before], 1)
    poses = se3.interpolate(from_before, from_after, np.clip((scans - rows[before]) / gap, 0.0, 1.0))
    nearest = np.where(np.abs(rows[after] - scans) < np.abs(scans - rows[before]), after, before)
    added = run.chain.covariance(rows[nearest], scans)
    added[rows[nearest] == scans] = 0.0
    covariances = se3.compose_covariance(node_covariances[nearest], run.chain.relative(rows[nearest], scans), added)
    return Trajectory(run.trajectory.stamps_ns, poses, covariances)
