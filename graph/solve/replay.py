"""A finished graph given to an online solver pose by pose, as if it had just been measured."""

from __future__ import annotations

import gtsam
import numpy as np

from hybridlio.core.errors import GraphError
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.solve.levenberg import Progress
from hybridlio.graph.solve.online_solver import OnlineSolver

_LAST_UPDATES = 3  # each linearises anew what has moved


def replay(data: GraphData, backend: str, lag: int, report: Progress) -> tuple[gtsam.Values, int]:
    """Values of all poses and of the velocities and biases in the lag, and how many updates it took.

    Each update brings one pose, and the factors whose last pose it is; the first ones wait until they are determined.

    Raises:
        GraphError: a factor reaches behind the lag, or the graph cannot be solved.
    """
    if backend == "fixed-lag":
        _check_spans(data, lag)
    grown = GraphData(data.dimension)
    solver = OnlineSolver(grown, backend, lag, forget=False)
    keys, initial, latest = data.keys, data.coordinates_or_nan, _by_latest(data)
    updates, wait = 0, 1
    for place, key in enumerate(keys):
        grown.put_poses([key], initial[place : place + 1])
        for number in latest[place]:
            grown.put_factor(data.factors[number])
        if key in data.fixed:
            grown.fix(key)
        if not len(solver) and place + 1 < min(wait, len(keys)):
            continue
        try:
            solver.update()
            updates += 1
        except GraphError:
            if place + 1 == len(keys):
                raise
            if len(solver):
                continue
            wait = 2 * (place + 1)
        report("updating", updates, 0.0)
    for _ in range(_LAST_UPDATES):
        solver.update()
    return solver.values(), updates


def _check_spans(data: GraphData, lag: int) -> None:
    spans = np.ptp(data.edges.ends, axis=1)
    if len(spans) and spans.max() > lag:
        factor = data.factors[int(data.edges.ids[np.argmax(spans)])]
        raise GraphError(f"{factor.label}: its poses are {spans.max()} apart in order, but the lag is {lag} poses")


def _by_latest(data: GraphData) -> list[list[int]]:
    """Ids of the factors by the place of their latest pose."""
    latest: list[list[int]] = [[] for _ in range(len(data))]
    for number, place in zip(data.edges.ids.tolist(), data.edges.ends.max(axis=1, initial=0).tolist(), strict=True):
        latest[place].append(number)
    for number, factor in data.others.items():
        latest[max(data.places[key] for key in factor.keys)].append(number)
    return [sorted(numbers) for numbers in latest]
