"""Gauss-Newton and Levenberg-Marquardt on a pose graph, with the linear solver that the graph's shape needs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.core.errors import GraphError
from hybridlio.graph.base.isam import gtsam_message
from hybridlio.graph.calibration.biases import BiasAt
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.solve.builder import Builder
from hybridlio.graph.solve.linear_solver import levenberg_marquardt_params, linear_solver, needs_qr, poses_of
from hybridlio.graph.solve.settings import IterationProgress

_ABSOLUTE_TOLERANCE = 1e-9  # of an error near zero, such as in a chain without loops: one residual of 4e-5 σ
_INERTIAL_ROUNDS = 2  # the second preintegrates the samples around the biases that the first found


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
        for _ in range(_INERTIAL_ROUNDS - 1 if self._builder.has_inertial_factors else 0):
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
        params.setLinearSolverType(linear_solver(self._use_qr))
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


def biases_of(values: gtsam.Values) -> BiasAt:
    """Return the estimated biases by variable, for a :class:`Builder`."""
    return values.atConstantBias
