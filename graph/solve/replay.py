"""A finished graph solved online: given to an online solver pose by pose, as if it were being measured."""

from __future__ import annotations

import gtsam
import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import GraphError
from hybridlio.graph.model.checks import check_determined, check_observed
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.solve.builder import Builder
from hybridlio.graph.solve.changes import check_followed
from hybridlio.graph.solve.engines import SHIFT_M, TURN_RAD
from hybridlio.graph.solve.initial_values import choose_start
from hybridlio.graph.solve.linear_solver import poses_of
from hybridlio.graph.solve.nonlinear import SolverResult, biases_of
from hybridlio.graph.solve.online_solver import OnlineSolver
from hybridlio.graph.solve.settings import IterationProgress, Settings
from hybridlio.graph.solve.solution import Solution

_LAST_UPDATES = 3  # each linearises anew what has moved, so they act as Gauss-Newton's last iterations


def solve_online(graph: GraphData, settings: Settings, report: IterationProgress) -> Solution:
    """Solve a graph by an online solver, in the order in which its poses were added.

    Velocities and biases of poses that left the lag are reported at their initial values.

    Raises:
        GraphError: the factors do not determine every pose, or a factor spans more than the lag; names the keys.
    """
    check_followed(graph)
    check_determined(graph)
    check_observed(graph)
    data = graph.copy()
    found, updates, is_settled = _replay(data, settings, report)
    values = Builder(data).values(poses_of(found, data.dimension))
    estimated = found.keys()
    for variable in estimated:
        values.erase(variable)
    values.insert(found)
    start = Builder(data).values(choose_start(data, settings.initial))
    factors = Builder(data, biases_of(values)).graph()
    errors = float(factors.error(start)), float(factors.error(values))
    poses = poses_of(values, data.dimension)
    return Solution(data, SolverResult(data, poses, *errors, updates, is_settled, (factors, values)))


def _replay(data: GraphData, settings: Settings, report: IterationProgress) -> tuple[gtsam.Values, int, bool]:
    """Return all poses with the velocities and biases in the lag, the number of updates, and whether they have settled.

    Each update brings one pose and the factors that become complete with it. Where the first poses are not determined
    by themselves, the first update waits for twice as many each time.
    """
    if settings.backend == "fixed-lag":
        _check_spans(data, settings.lag)
    grown = GraphData(data.dimension)
    grown.landmarks = data.landmarks.copy()  # the solver takes each at its first observation
    solver = OnlineSolver(grown, settings.backend, settings.lag, forget=False)
    keys, initial, complete = data.keys, data.initial_values, _ids_by_latest_pose(data)
    updates, needed = 0, 1
    for k, key in enumerate(keys):
        grown.add_poses([key], initial[k : k + 1])
        for factor_id in complete[k]:
            grown.add_factor(data.factors[factor_id])
        if key in data.fixed:
            grown.fix(key)
        if not len(solver) and k + 1 < min(needed, len(keys)):
            continue
        try:
            solver.update()
            updates += 1
        except GraphError:
            if k + 1 == len(keys):
                raise
            if len(solver):
                continue
            needed = 2 * (k + 1)
        report("updating", updates, 0.0)
    for _ in range(_LAST_UPDATES - 1):
        solver.update()
    before = solver.poses
    solver.update()
    return solver.values(), updates, _is_settled(before, solver.poses)


def _is_settled(before: Array, after: Array) -> bool:
    """Return whether no pose ``(N, 4, 4)`` has moved by more than GTSAM tolerates without linearising anew."""
    moved = np.abs(se3.log(se3.between(before, after))).reshape(-1, 2, 3)
    return bool((moved <= np.array([[TURN_RAD], [SHIFT_M]])).all())


def _check_spans(data: GraphData, lag: int) -> None:
    spans = np.ptp(data.edges.ends, axis=1)
    if len(spans) and spans.max() > lag:
        factor = data.factors[int(data.edges.ids[np.argmax(spans)])]
        raise GraphError(f"{factor.label}: its poses are {spans.max()} apart in order, but the lag is {lag} poses")


def _ids_by_latest_pose(data: GraphData) -> list[list[int]]:
    """Return, by pose, the ids of the factors whose latest pose it is."""
    latest: list[list[int]] = [[] for _ in range(len(data))]
    for factor_id, k in zip(data.edges.ids.tolist(), data.edges.ends.max(axis=1, initial=0).tolist(), strict=True):
        latest[k].append(factor_id)
    for factor_id, factor in data.other_factors.items():
        latest[max(data.index[key] for key in factor.keys)].append(factor_id)
    return [sorted(ids) for ids in latest]
