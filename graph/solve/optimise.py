"""Solving a pose graph: where to start, which solver, and what came out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

from hybridlio.core.errors import ConfigError
from hybridlio.graph.model.checks import check_determined
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.solve.build import Builder
from hybridlio.graph.solve.gnc import reject_outliers, start_without_loops
from hybridlio.graph.solve.levenberg import Descent, Progress, Solved, biases_of, poses_of, silent
from hybridlio.graph.solve.replay import replay
from hybridlio.graph.solve.solution import Solution
from hybridlio.graph.solve.starts import METHODS, choose_start

Backend: TypeAlias = Literal["auto", "batch", "gnc", "incremental", "fixed-lag"]
Initial: TypeAlias = Literal["auto", "given", "odometry", "spanning-tree", "chordal"]
BACKENDS = ("auto", "batch", "gnc", "incremental", "fixed-lag")
INITIAL = ("auto", "given", *METHODS)
LAG = 200  # poses


@dataclass(frozen=True)
class Settings:
    """Of :meth:`hybridlio.graph.pose_graph.PoseGraph.optimize`.

    Raises:
        ConfigError: one of them cannot be.
    """

    backend: str = "auto"
    initial: str = "auto"
    max_iterations: int = 100
    tolerance: float = 1e-6
    lag: int = LAG

    def __post_init__(self) -> None:
        if self.backend not in BACKENDS:
            raise ConfigError(f"no backend is called {self.backend!r}; there are {', '.join(BACKENDS)}")
        if self.initial not in INITIAL:
            raise ConfigError(f"initial={self.initial!r}: there are {', '.join(INITIAL)}")
        if self.max_iterations < 1 or not self.tolerance > 0 or self.lag < 1:
            raise ConfigError(
                f"max_iterations {self.max_iterations}, tolerance {self.tolerance}, lag {self.lag}: all are positive"
            )


def optimise(graph: GraphData, settings: Settings, progress: Progress | None) -> Solution:
    """Solve a pose graph; see :meth:`hybridlio.graph.pose_graph.PoseGraph.optimize`."""
    check_determined(graph)
    report = progress or silent
    data = graph.without()
    if settings.backend == "gnc":
        return _reject(data, settings, report)
    if settings.backend in ("incremental", "fixed-lag"):
        return Solution(data, _replayed(data, settings, report))
    descend = Descent(data, settings.max_iterations, settings.tolerance, report)
    return Solution(data, descend(choose_start(data, settings.initial)))


def _reject(data: GraphData, settings: Settings, report: Progress) -> Solution:
    start = start_without_loops(data) if settings.initial == "auto" else None
    start = choose_start(data, settings.initial) if start is None else start
    start, rejected = reject_outliers(data, start, report)
    kept = data.without(rejected)
    check_determined(kept)
    return Solution(data, Descent(kept, settings.max_iterations, settings.tolerance, report)(start), rejected)


def _replayed(data: GraphData, settings: Settings, report: Progress) -> Solved:
    found, updates = replay(data, settings.backend, settings.lag, report)
    values = Builder(data).values(poses_of(found, data.dimension))
    variables = found.keys()
    for variable in variables:
        values.erase(variable)
    values.insert(found)
    start = Builder(data).values(choose_start(data, settings.initial))
    graph = Builder(data, biases_of(values)).graph()
    errors = float(graph.error(start)), float(graph.error(values))
    return Solved(data, graph, values, poses_of(values, data.dimension), *errors, updates, True, True)
