"""Gauss-Newton and Levenberg-Marquardt on a pose graph, with the linear solver that its shape asks for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeAlias

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import GraphError
from hybridlio.graph.base.isam import gtsam_message
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.solve.build import Builder

Progress: TypeAlias = Callable[[str, int, float], None]

# Cholesky's normal equations lose the far end of a chain without a word: nothing at 1,000 poses, a centimetre at 2,000,
# half a metre at 5,000. QR does not, and on a chain it costs little; on a dense graph it costs several times more.
_LONGEST_FOR_CHOLESKY = 1000
TOLERANCE = 1e-6  # of the error: poses then lie within a few thousandths of a standard deviation
_ABSOLUTE_TOLERANCE = 1e-9
_INERTIAL_ROUNDS = 2  # samples are summed up again around the biases that the first round found


def silent(stage: str, iteration: int, error: float) -> None:
    """Report to nobody."""
    del stage, iteration, error


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


@dataclass(frozen=True, eq=False)
class _Stepped:
    """Where iterations led, errors before and after them; ``failed`` if the next one would raise the error."""

    values: gtsam.Values
    before: float
    error: float
    iterations: int
    converged: bool
    failed: bool = False


def _settled(errors: list[float], tolerance: float) -> bool:
    """Whether what further steps would gain is nothing, if each gains the same share of the one before."""
    gains = -np.diff(errors[-3:])
    enough = max(tolerance * errors[-1], _ABSOLUTE_TOLERANCE)
    if gains[-1] <= enough:
        return True
    share = gains[-1] / gains[0] if len(gains) == 2 else 1.0
    return bool(share < 1 and gains[-1] * share / (1 - share) <= enough)


class Descent:
    """Optimises a pose graph from one start or several."""

    def __init__(self, data: GraphData, max_iterations: int, tolerance: float, report: Progress) -> None:
        self._data, self._max_iterations, self._tolerance, self._report = data, max_iterations, tolerance, report
        self._builder = Builder(data)
        self._orthogonal = needs_orthogonal(data)
        self._graph = self._builder.graph()

    def __call__(self, start: Array) -> Solved:
        """Gauss-Newton from ``start`` as long as the error falls, Levenberg-Marquardt from there.

        Raises:
            GraphError: the factors do not determine every variable.
        """
        graph = self._graph
        stepped = self._descend(graph, self._builder.values(start))
        inertial = self._builder.with_bias()
        for _ in range(_INERTIAL_ROUNDS - 1 if inertial else 0):
            graph = Builder(self._data, biases_of(stepped.values)).graph()
            again = self._descend(graph, stepped.values)
            stepped = replace(again, before=stepped.before, iterations=stepped.iterations + again.iterations)
        values, poses = stepped.values, poses_of(stepped.values, self._data.dimension)
        return Solved(
            self._data, graph, values, poses, stepped.before, stepped.error, stepped.iterations, stepped.converged,
            self._orthogonal,
        )  # fmt: skip

    def _descend(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> _Stepped:
        stepped = self._undamped(graph, values)
        return self._damped(graph, stepped) if stepped.failed else stepped

    def _undamped(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> _Stepped:
        """Gauss-Newton, which may go up once if it is lower than before one step later.

        A watchdog of length one (Chamberlain, Powell, Lemarechal, Pedersen, "The watchdog technique for forcing
        convergence in algorithms for constrained optimization", 1982): where the ground bends, the step that damping
        would cut into ten leads across.
        """
        params = gtsam.GaussNewtonParams()
        params.setLinearSolverType(_linear_solver(self._orthogonal))
        optimiser = gtsam.GaussNewtonOptimizer(graph, values, params)
        best, errors, rose = values, [float(optimiser.error())], False
        for done in range(1, self._max_iterations + 1):
            try:
                optimiser.iterate()
            except RuntimeError:  # damping may solve what is indeterminate here
                return _Stepped(best, errors[0], errors[-1], done - 1, False, failed=True)
            error = float(optimiser.error())
            if error <= errors[-1]:
                best, rose = gtsam.Values(optimiser.values()), False  # a copy: the next iteration frees it
                errors.append(error)
                self._report("optimising", done, error)
                if _settled(errors, self._tolerance):
                    return _Stepped(best, errors[0], error, done, True)
            elif rose or not np.isfinite(error):
                return _Stepped(best, errors[0], errors[-1], done, False, failed=True)
            else:
                rose = True
        return _Stepped(best, errors[0], errors[-1], self._max_iterations, False)

    def _damped(self, graph: gtsam.NonlinearFactorGraph, stepped: _Stepped) -> _Stepped:
        """Levenberg-Marquardt from where Gauss-Newton stopped."""
        done, report = stepped.iterations, self._report
        params = parameters(self._orthogonal, self._tolerance)
        params.setMaxIterations(max(self._max_iterations - done, 1))
        params.iterationHook = lambda number, _before, after: report("optimising", done + int(number), float(after))
        optimiser = gtsam.LevenbergMarquardtOptimizer(graph, stepped.values, params)
        try:
            values = optimiser.optimize()
        except RuntimeError as error:
            raise GraphError(f"the graph cannot be solved: {gtsam_message(error)}") from error
        total = done + int(optimiser.iterations())
        return _Stepped(values, stepped.before, float(optimiser.error()), total, total < self._max_iterations)


def parameters(orthogonal: bool, tolerance: float = TOLERANCE) -> gtsam.LevenbergMarquardtParams:
    """Of Levenberg-Marquardt, as used everywhere here."""
    params = gtsam.LevenbergMarquardtParams()
    params.setLinearSolverType(_linear_solver(orthogonal))
    params.setRelativeErrorTol(tolerance)
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


def poses_of(values: gtsam.Values, dimension: int) -> Array:
    """Coordinates ``(N, 7)`` or ``(N, 3)`` of all poses."""
    if dimension == 2:
        return np.array(gtsam.utilities.extractPose2(values)).reshape(-1, 3)
    rows = np.array(gtsam.utilities.extractPose3(values)).reshape(-1, 12)  # rotation by rows, then position
    return co.from_matrices(se3.make(rows[:, :9].reshape(-1, 3, 3), rows[:, 9:]), 3)


def biases_of(values: gtsam.Values) -> Callable[[int], gtsam.imuBias.ConstantBias]:
    """Biases by place, as the builder asks for them."""
    return lambda place: values.atConstantBias(B(place))


def _linear_solver(orthogonal: bool) -> str:
    return "MULTIFRONTAL_QR" if orthogonal else "MULTIFRONTAL_CHOLESKY"
