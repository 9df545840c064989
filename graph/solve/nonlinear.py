"""Gauss-Newton and Levenberg-Marquardt on a pose graph, with the linear solver that the graph's shape needs."""

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
from hybridlio.core.arrays import Array, Index
from hybridlio.core.errors import GraphError
from hybridlio.graph.base.isam import gtsam_message
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.solve.builder import BiasAt, Builder

IterationProgress: TypeAlias = Callable[[str, int, float], None]  # stage, iteration, error

# Cholesky squares the condition number, and without a warning loses the far end of a chain: nothing at 1,000 poses, a
# centimetre at 2,000, half a metre at 5,000. QR does not; it costs little on a chain, several times more on a dense
# graph.
_LONGEST_FOR_CHOLESKY = 1000
TOLERANCE = 1e-6  # of the error: poses then lie within a few thousandths of a standard deviation
_ABSOLUTE_TOLERANCE = 1e-9  # of an error near zero, such as in a chain without loops: one residual of 4e-5 σ
_INERTIAL_ROUNDS = 2  # the second preintegrates the samples around the biases that the first found


def silent(stage: str, iteration: int, error: float) -> None:
    """Ignore progress."""
    del stage, iteration, error


@dataclass(frozen=True, eq=False)
class SolverResult:
    """Result of a solver.

    Attributes:
        data: the graph that was solved.
        graph: GTSAM's factors; those of ``data`` come first, in :meth:`Builder.factor_ids`' order.
        values: GTSAM's values at the optimum.
        poses: coordinates ``(N, 7)`` or ``(N, 3)`` at the optimum.
        error_before: half the sum of squared, whitened residuals at the start, under the robust kernels.
        error: the same at the optimum.
        iterations: of Gauss-Newton and Levenberg-Marquardt together.
        converged: whether the error had stopped falling.
        used_qr: whether the linear solver was QR.
    """

    data: GraphData
    graph: gtsam.NonlinearFactorGraph
    values: gtsam.Values
    poses: Array
    error_before: float
    error: float
    iterations: int
    converged: bool
    used_qr: bool


@dataclass(frozen=True, eq=False)
class _Descended:
    """Where some iterations led.

    Attributes:
        values: at the smallest error.
        before, error: errors before and after the iterations.
        iterations: their number.
        converged: whether the error had stopped falling.
        failed: whether the next undamped step could not be solved, or raised the error.
    """

    values: gtsam.Values
    before: float
    error: float
    iterations: int
    converged: bool
    failed: bool = False


def _has_converged(errors: list[float], tolerance: float) -> bool:
    """Return whether all further steps together gain less than the tolerance.

    Gains are taken to shrink geometrically, by the ratio of the last two: a step of gain g then has g·q/(1−q) to come.
    """
    gains = -np.diff(errors[-3:])
    enough = max(tolerance * errors[-1], _ABSOLUTE_TOLERANCE)
    if gains[-1] <= enough:
        return True
    ratio = gains[-1] / gains[0] if len(gains) == 2 else 1.0
    return bool(ratio < 1 and gains[-1] * ratio / (1 - ratio) <= enough)


class NonlinearSolver:
    """Optimises a pose graph from one start or several.

    Args:
        data: the graph.
        max_iterations: of Gauss-Newton and Levenberg-Marquardt together.
        tolerance: share of the error that further iterations may still gain.
        report: called with the stage, the iteration and the error there.
    """

    def __init__(self, data: GraphData, max_iterations: int, tolerance: float, report: IterationProgress) -> None:
        self._data, self._max_iterations, self._tolerance, self._report = data, max_iterations, tolerance, report
        self._builder = Builder(data)
        self._use_qr = needs_qr(data)
        self._graph = self._builder.graph()

    def __call__(self, start: Array) -> SolverResult:
        """Solve from coordinates ``start``: Gauss-Newton while the error falls, then Levenberg-Marquardt.

        Raises:
            GraphError: the factors do not determine every variable.
        """
        graph = self._graph
        found = self._descend(graph, self._builder.values(start))
        inertial = self._builder.poses_with_bias()
        for _ in range(_INERTIAL_ROUNDS - 1 if inertial else 0):
            graph = Builder(self._data, biases_of(found.values)).graph()
            again = self._descend(graph, found.values)
            found = replace(again, before=found.before, iterations=found.iterations + again.iterations)
        poses = poses_of(found.values, self._data.dimension)
        return SolverResult(
            self._data, graph, found.values, poses, found.before, found.error, found.iterations, found.converged,
            self._use_qr,
        )  # fmt: skip

    def _descend(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> _Descended:
        found = self._undamped(graph, values)
        return self._damped(graph, found) if found.failed else found

    def _undamped(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> _Descended:
        """Run Gauss-Newton; the error may rise in one step if it is below its old value after the next.

        A watchdog of length one (Chamberlain, Powell, Lemarechal, Pedersen, "The watchdog technique for forcing
        convergence in algorithms for constrained optimization", 1982): along a curved valley a full step crosses where
        damping would take ten.
        """
        params = gtsam.GaussNewtonParams()
        params.setLinearSolverType(_linear_solver(self._use_qr))
        optimiser = gtsam.GaussNewtonOptimizer(graph, values, params)
        best, errors, rose = values, [float(optimiser.error())], False
        for done in range(1, self._max_iterations + 1):
            try:
                optimiser.iterate()
            except RuntimeError:  # an indeterminate system: damping may solve it
                return _Descended(best, errors[0], errors[-1], done - 1, False, failed=True)
            error = float(optimiser.error())
            if error <= errors[-1]:
                best, rose = gtsam.Values(optimiser.values()), False  # a copy: the next iteration frees it
                errors.append(error)
                self._report("optimising", done, error)
                if _has_converged(errors, self._tolerance):
                    return _Descended(best, errors[0], error, done, True)
            elif rose or not np.isfinite(error):
                return _Descended(best, errors[0], errors[-1], done, False, failed=True)
            else:
                rose = True
        return _Descended(best, errors[0], errors[-1], self._max_iterations, False)

    def _damped(self, graph: gtsam.NonlinearFactorGraph, found: _Descended) -> _Descended:
        """Run Levenberg-Marquardt from where Gauss-Newton stopped."""
        done, report = found.iterations, self._report
        params = levenberg_marquardt_params(self._use_qr, self._tolerance)
        params.setMaxIterations(max(self._max_iterations - done, 1))
        params.iterationHook = lambda number, _before, after: report("optimising", done + int(number), float(after))
        optimiser = gtsam.LevenbergMarquardtOptimizer(graph, found.values, params)
        try:
            values = optimiser.optimize()
        except RuntimeError as error:
            raise GraphError(f"the graph cannot be solved: {gtsam_message(error)}") from error
        total = done + int(optimiser.iterations())
        return _Descended(values, found.before, float(optimiser.error()), total, total < self._max_iterations)


def levenberg_marquardt_params(use_qr: bool, tolerance: float = TOLERANCE) -> gtsam.LevenbergMarquardtParams:
    """Return the parameters of Levenberg-Marquardt that all solvers here use."""
    params = gtsam.LevenbergMarquardtParams()
    params.setLinearSolverType(_linear_solver(use_qr))
    params.setRelativeErrorTol(tolerance)
    return params


def needs_qr(data: GraphData) -> bool:
    """Return whether Cholesky would lose precision: long chains far from any fixed or measured pose, or an IMU."""
    if any(factor.kind == "imu" for factor in data.other_factors.values()):
        return True  # biases of 1e-4 and positions of kilometres in one system
    if len(data) <= _LONGEST_FOR_CHOLESKY or not len(data.edges):
        return False
    anchored = {f.keys[0] for f in data.other_factors.values() if f.kind in ("prior", "gps")} | data.fixed
    return _farthest_pose(data, [data.index[key] for key in anchored]) > _LONGEST_FOR_CHOLESKY


def _farthest_pose(data: GraphData, anchored: list[int]) -> int:
    """Return the number of edges between the farthest pose and its nearest anchored one."""
    count = len(data) + len(data.landmarks)  # nodes: poses, then landmarks
    to_anchored = np.column_stack([np.full(len(anchored), count), anchored])  # from one more node, the root
    ends = np.vstack([data.edges.ends, _observation_ends(data), to_anchored])
    adjacency = coo_matrix((np.ones(len(ends), dtype=np.int8), ends.T), shape=(count + 1, count + 1))
    _, parent = breadth_first_order(adjacency.tocsr(), count, directed=False)
    parent[parent < 0] = count
    # depth of every node by pointer doubling: log(depth) passes over arrays instead of a walk per node
    depth, ancestor = (parent != count).astype(np.int64), parent
    while (ancestor != count).any():
        depth, ancestor = depth + depth[ancestor], ancestor[ancestor]
    return int(depth.max())


def _observation_ends(data: GraphData) -> Index:
    """Return ``(M, 2)`` indices of the pose and the landmark of each observation, landmarks counted after poses."""
    observations = (f for f in data.other_factors.values() if f.landmark is not None)
    landmarks = data.landmarks.index
    ends = [(data.index[f.keys[0]], len(data) + landmarks[f.landmark]) for f in observations if f.landmark is not None]
    return np.array(ends, dtype=np.int64).reshape(-1, 2)


def poses_of(values: gtsam.Values, dimension: int) -> Array:
    """Return the coordinates ``(N, 7)`` or ``(N, 3)`` of all poses."""
    if dimension == 2:
        return np.array(gtsam.utilities.extractPose2(values)).reshape(-1, 3)
    rows = np.array(gtsam.utilities.extractPose3(values)).reshape(-1, 12)  # rotation by rows, then position
    return co.from_matrices(se3.make(rows[:, :9].reshape(-1, 3, 3), rows[:, 9:]), 3)


def biases_of(values: gtsam.Values) -> BiasAt:
    """Return the estimated biases by pose index, for a :class:`Builder`."""
    return lambda index: values.atConstantBias(B(index))


def _linear_solver(use_qr: bool) -> str:
    return "MULTIFRONTAL_QR" if use_qr else "MULTIFRONTAL_CHOLESKY"
