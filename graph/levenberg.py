"""Gauss-Newton and Levenberg-Marquardt on a pose graph, with the linear solver that its shape asks for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order

from hybridlio import se3
from hybridlio.errors import GraphError
from hybridlio.estimates import Array
from hybridlio.graph import coordinates as co
from hybridlio.graph.build import Builder
from hybridlio.graph.graph_data import GraphData

Progress: TypeAlias = Callable[[str, int, float], None]

# Cholesky's normal equations lose the far end of a chain without a word: nothing at 1,000 poses, a centimetre at 2,000,
# half a metre at 5,000. QR does not, and on a chain it costs little; on a dense graph it costs several times more.
_LONGEST_FOR_CHOLESKY = 1000
_RELATIVE_TOLERANCE = 1e-6
_ABSOLUTE_TOLERANCE = 1e-9
_INERTIAL_ROUNDS = 2  # samples are summed up again around the biases that the first round found


@dataclass(frozen=True, eq=False)
class Solved:
    """What the solver leaves.

    Attributes:
        graph: GTSAM's factors, those of ``data`` in order and first.
        values: GTSAM's values at the answer.
        poses: ``(N, 7)`` or ``(N, 3)`` coordinates at the answer.
        error_before: half the sum of squared, whitened residuals at the start, by the kernels where there are any.
        error: the same at the answer.
        iterations: steps of either.
        converged: whether the error had stopped falling.
        orthogonal: whether QR was used.
    """

    data: GraphData
    graph: gtsam.NonlinearFactorGraph
    values: gtsam.Values
    poses: Array
    error_before: float
    error: float
    iterations: int
    converged: bool
    orthogonal: bool


def solve(data: GraphData, start: Array, max_iterations: int, report: Progress) -> Solved:
    """Optimise from ``start``, coordinates ``(N, 7)`` or ``(N, 3)``; fixed poses stay there.

    Raises:
        GraphError: the factors do not determine every variable.
    """
    builder = Builder(data)
    orthogonal = needs_orthogonal(data)
    graph = builder.graph(start)
    values = builder.values(start)
    errors: list[float] = []
    iterations, converged = 0, False
    inertial = builder.with_bias()
    for number in range(_INERTIAL_ROUNDS if inertial else 1):
        if number:
            builder = Builder(data, _biases(values, inertial, len(data)))
            graph = builder.graph(start)
        errors.append(float(graph.error(values)))
        values, done, converged = _descend(graph, values, orthogonal, max_iterations, report)
        iterations += done
    poses, error = poses_of(values, data), float(graph.error(values))
    return Solved(data, graph, values, poses, errors[0], error, iterations, converged, orthogonal)


def parameters(orthogonal: bool) -> gtsam.LevenbergMarquardtParams:
    """Of Levenberg-Marquardt, as used everywhere here."""
    params = gtsam.LevenbergMarquardtParams()
    params.setLinearSolverType(_linear_solver(orthogonal))
    params.setRelativeErrorTol(_RELATIVE_TOLERANCE)
    return params


def needs_orthogonal(data: GraphData) -> bool:
    """Whether some pose is so many factors away from what is fixed or measured that only QR reaches it."""
    if any(factor.kind == "imu" for factor in data.others.values()):
        return True  # biases of 1e-4 beside positions of kilometres
    if len(data) <= _LONGEST_FOR_CHOLESKY or not len(data.edges):
        return False
    placed = {f.keys[0] for f in data.others.values() if f.kind in ("prior", "gps")} | data.fixed
    return _steps_away(data, [data.places[key] for key in placed]) > _LONGEST_FOR_CHOLESKY


def _steps_away(data: GraphData, places: list[int]) -> int:
    """How many between-factors the farthest pose is away from any of some poses."""
    count = len(data)
    start = np.column_stack([np.full(len(places), count), places])  # one more node, next to all of them
    ends = np.vstack([data.edges.ends, start])
    joined = coo_matrix((np.ones(len(ends), dtype=np.int8), ends.T), shape=(count + 1, count + 1))
    _, before = breadth_first_order(joined.tocsr(), count, directed=False)
    before[before < 0] = count
    steps, hop = (before != count).astype(np.int64), before
    while (hop != count).any():
        steps, hop = steps + steps[hop], hop[hop]
    return int(steps.max())


def poses_of(values: gtsam.Values, data: GraphData) -> Array:
    """Coordinates ``(N, 7)`` or ``(N, 3)`` of all poses."""
    if data.dimension == 2:
        return np.array(gtsam.utilities.extractPose2(values)).reshape(-1, 3)
    rows = np.array(gtsam.utilities.extractPose3(values)).reshape(-1, 12)  # rotation by rows, then position
    return co.from_matrices(se3.make(rows[:, :9].reshape(-1, 3, 3), rows[:, 9:]), 3)


def _biases(values: gtsam.Values, places: list[int], count: int) -> Array:
    biases = np.zeros((count, 6))
    for k in places:
        biases[k] = values.atConstantBias(B(k)).vector()
    return biases


def _descend(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, orthogonal: bool, max_iterations: int, report: Progress
) -> tuple[gtsam.Values, int, bool]:
    """Gauss-Newton as long as the error falls, Levenberg-Marquardt from there: values, iterations, converged."""
    params = gtsam.GaussNewtonParams()
    params.setLinearSolverType(_linear_solver(orthogonal))
    optimiser = gtsam.GaussNewtonOptimizer(graph, values, params)
    before = float(optimiser.error())
    for done in range(1, max_iterations + 1):
        values = gtsam.Values(optimiser.values())  # a copy: the next iteration frees what it returned
        try:
            optimiser.iterate()
        except RuntimeError:  # damping may solve what is indeterminate here
            return _damped(graph, values, orthogonal, max_iterations, done - 1, report)
        after = float(optimiser.error())
        if not after <= before:
            return _damped(graph, values, orthogonal, max_iterations, done - 1, report)
        report("optimising", done, after)
        if before - after <= max(_RELATIVE_TOLERANCE * before, _ABSOLUTE_TOLERANCE):
            return gtsam.Values(optimiser.values()), done, True
        before = after
    return gtsam.Values(optimiser.values()), max_iterations, False


def _damped(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, orthogonal: bool, max_iterations: int, done: int,
    report: Progress,
) -> tuple[gtsam.Values, int, bool]:  # fmt: skip
    """Levenberg-Marquardt after ``done`` iterations."""
    params = parameters(orthogonal)
    params.setMaxIterations(max_iterations - done)
    params.iterationHook = lambda number, _before, after: report("optimising", done + int(number), float(after))
    optimiser = gtsam.LevenbergMarquardtOptimizer(graph, values, params)
    try:
        values = optimiser.optimize()
    except RuntimeError as error:
        raise GraphError(f"the graph cannot be solved: {' '.join(str(error).split())}") from error
    total = done + int(optimiser.iterations())
    return values, total, total < max_iterations


def _linear_solver(orthogonal: bool) -> str:
    return "MULTIFRONTAL_QR" if orthogonal else "MULTIFRONTAL_CHOLESKY"
