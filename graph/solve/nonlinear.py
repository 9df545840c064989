"""Gauss-Newton and Levenberg-Marquardt on a pose graph, with the linear solver that the graph's shape needs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

import gtsam
import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.core.errors import GraphError
from hybridlio.graph.base.isam import gtsam_message
from hybridlio.graph.calibration.biases import BiasAt
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.planar.gauss_newton import PlanarGaussNewton, solves
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
        poses: coordinates ``(N, 7)`` or ``(N, 3)`` at the optimum.
        error_before: half the sum of squared, whitened residuals at the start, under the robust kernels.
        error: the same at the optimum.
        iterations: of Gauss-Newton and Levenberg-Marquardt together.
        converged: whether the error had stopped falling.
        made: GTSAM's factors and values at the optimum, where they exist already.
    """

    data: GraphData
    poses: Array
    error_before: float
    error: float
    iterations: int
    converged: bool
    made: tuple[gtsam.NonlinearFactorGraph, gtsam.Values] | None = None

    @property
    def graph(self) -> gtsam.NonlinearFactorGraph:
        """GTSAM's factors; those of ``data`` come first, in :meth:`Builder.factor_ids`' order."""
        return self._made[0]

    @property
    def values(self) -> gtsam.Values:
        """GTSAM's values at the optimum."""
        return self._made[1]

    @cached_property
    def uses_qr(self) -> bool:
        """Whether the linear solver is, or would have to be, QR."""
        return needs_qr(self.data)

    @cached_property
    def _made(self) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        if self.made is not None:
            return self.made
        builder = Builder(self.data)
        return builder.graph(), builder.values(self.poses)


class _Optimiser(Protocol):
    """Gauss-Newton, one step at a time."""

    def iterate(self) -> None:
        """Take one step; raise RuntimeError where it is not determined."""

    def error(self) -> float:
        """Return the error at the present state."""

    def state(self) -> Any:
        """Return a copy of the present state."""


class _GtsamGaussNewton:
    def __init__(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, use_qr: bool) -> None:
        params = gtsam.GaussNewtonParams()
        params.setLinearSolverType(linear_solver(use_qr))
        self._optimiser = gtsam.GaussNewtonOptimizer(graph, values, params)

    def iterate(self) -> None:
        self._optimiser.iterate()

    def error(self) -> float:
        return float(self._optimiser.error())

    def state(self) -> gtsam.Values:
        return gtsam.Values(self._optimiser.values())  # a copy: the next iteration frees it


@dataclass(frozen=True, eq=False)
class _Descended:
    """Where some iterations led.

    Attributes:
        state: where the error is smallest: GTSAM's values, or coordinates of a planar graph.
        before, error: errors before and after the iterations.
        iterations: their number.
        converged: whether the error had stopped falling.
        failed: whether the next undamped step could not be solved, or raised the error.
    """

    state: Any
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

    def __call__(self, start: Array) -> SolverResult:
        """Solve from coordinates ``start``: Gauss-Newton while the error falls, then Levenberg-Marquardt.

        Raises:
            GraphError: the factors do not determine every variable.
        """
        if solves(self._data):
            found = self._undamped(PlanarGaussNewton(self._data, start))
            if not found.failed:
                return self._result(found, found.state)
            start = found.state
            return replace(self._by_gtsam(start, found.iterations), error_before=found.before)
        return self._by_gtsam(start)

    def _by_gtsam(self, start: Array, done: int = 0) -> SolverResult:
        graph, use_qr = self._builder.graph(), needs_qr(self._data)
        found = self._descend(graph, self._builder.values(start), use_qr, done)
        for _ in range(_INERTIAL_ROUNDS - 1 if self._builder.has_inertial_factors else 0):
            graph = Builder(self._data, biases_of(found.state)).graph()
            again = self._descend(graph, found.state, use_qr)
            found = replace(again, before=found.before, iterations=found.iterations + again.iterations)
        return self._result(found, poses_of(found.state, self._data.dimension), (graph, found.state))

    def _result(self, found: _Descended, poses: Array, made: Any = None) -> SolverResult:
        return SolverResult(
            self._data, poses, found.before, found.error, found.iterations, found.converged, made
        )  # fmt: skip

    def _descend(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, use_qr: bool, done: int = 0
    ) -> _Descended:  # fmt: skip
        """Run Gauss-Newton, and Levenberg-Marquardt where it fails; it has failed already after ``done`` iterations."""
        before = float(graph.error(values))
        found = _Descended(values, before, before, done, False, failed=True)
        found = found if done else self._undamped(_GtsamGaussNewton(graph, values, use_qr))
        return self._damped(graph, found, use_qr) if found.failed else found

    def _undamped(self, optimiser: _Optimiser) -> _Descended:
        """Run Gauss-Newton; the error may rise in one step if it is below its old value after the next.

        A watchdog of length one (Chamberlain, Powell, Lemarechal, Pedersen, "The watchdog technique for forcing
        convergence in algorithms for constrained optimization", 1982): along a curved valley a full step crosses where
        damping would take ten.
        """
        best, errors, rose = optimiser.state(), [optimiser.error()], False
        for done in range(1, self._max_iterations + 1):
            try:
                optimiser.iterate()
            except RuntimeError:  # an indeterminate system: damping may solve it
                return _Descended(best, errors[0], errors[-1], done - 1, False, failed=True)
            error = optimiser.error()
            if error <= errors[-1]:
                best, rose = optimiser.state(), False
                errors.append(error)
                self._report("optimising", done, error)
                if _has_converged(errors, self._tolerance):
                    return _Descended(best, errors[0], error, done, True)
            elif rose or not np.isfinite(error):
                return _Descended(best, errors[0], errors[-1], done, False, failed=True)
            else:
                rose = True
        return _Descended(best, errors[0], errors[-1], self._max_iterations, False)

    def _damped(self, graph: gtsam.NonlinearFactorGraph, found: _Descended, use_qr: bool) -> _Descended:
        """Run Levenberg-Marquardt from where Gauss-Newton stopped."""
        done, report = found.iterations, self._report
        params = levenberg_marquardt_params(use_qr, self._tolerance)
        params.setMaxIterations(max(self._max_iterations - done, 1))
        params.iterationHook = lambda number, _before, after: report("optimising", done + int(number), float(after))
        optimiser = gtsam.LevenbergMarquardtOptimizer(graph, found.state, params)
        try:
            values = optimiser.optimize()
        except RuntimeError as error:
            raise GraphError(f"the graph cannot be solved: {gtsam_message(error)}") from error
        total = done + int(optimiser.iterations())
        return _Descended(values, found.before, float(optimiser.error()), total, total < self._max_iterations)


def biases_of(values: gtsam.Values) -> BiasAt:
    """Return the estimated biases by variable, for a :class:`Builder`."""
    return values.atConstantBias
