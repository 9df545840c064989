"""Solving a whole pose graph at once, with or without rejection of wrong loop closures."""

from __future__ import annotations

from hybridlio.graph.calibration.plain_steps import plain_steps
from hybridlio.graph.model.checks import check_determined, check_observed
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.outliers.rejection import reject_outliers
from hybridlio.graph.solve.growing_start import grow_start
from hybridlio.graph.solve.initial_values import choose_start
from hybridlio.graph.solve.nonlinear import NonlinearSolver
from hybridlio.graph.solve.settings import IterationProgress, Settings
from hybridlio.graph.solve.solution import Solution


def solve_batch(graph: GraphData, settings: Settings, report: IterationProgress) -> Solution:
    """Solve a graph by Gauss-Newton and Levenberg-Marquardt, after ``gnc`` where the settings ask for it.

    Raises:
        GraphError: the factors do not determine every pose; names the keys.
    """
    check_determined(graph)
    check_observed(graph)
    data = graph.copy()
    if settings.backend == "gnc":
        return _solve_without_outliers(data, settings, report)
    solver = NonlinearSolver(data, settings.max_iterations, settings.tolerance, report)
    start = choose_start(data, settings.initial)
    return Solution(data, solver(grow_start(data, start, report) if settings.initial == "auto" else start))


def _solve_without_outliers(data: GraphData, settings: Settings, report: IterationProgress) -> Solution:
    start = None if settings.initial == "auto" else choose_start(data, settings.initial)
    plain, sensor_steps = plain_steps(data)  # loops are judged with the calibration as stated
    found = reject_outliers(plain, start, report)
    wrong = frozenset(sensor_steps.get(number, number) for number in found.wrong)
    kept = data.copy(without=wrong)
    check_determined(kept)
    solver = NonlinearSolver(kept, settings.max_iterations, settings.tolerance, report)
    return Solution(data, solver(found.start), wrong, found.doubts)
