"""Solving a pose graph: where to start, which solver, and what came out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import ConfigError, GraphError
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.checks import check_determined, labels
from hybridlio.graph.model.edge_arrays import Edges, edges_of
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.model.keys import named
from hybridlio.graph.model.measurements import Factor
from hybridlio.graph.solve.build import Builder
from hybridlio.graph.solve.levenberg import Descent, Progress, Solved, biases_of, poses_of
from hybridlio.graph.solve.solution import Solution
from hybridlio.graph.solve.starts import METHODS, find

Backend: TypeAlias = Literal["auto", "batch", "gnc", "incremental", "fixed-lag"]
Initial: TypeAlias = Literal["auto", "given", "odometry", "spanning-tree", "chordal"]
BACKENDS = ("auto", "batch", "gnc", "incremental", "fixed-lag")
INITIAL = ("auto", "given", *METHODS)
LAG = 200  # poses
_FITS = 2.0  # times the degrees of freedom


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
    from hybridlio.graph.solve.gnc import reject_outliers, start_without_loops

    start = start_without_loops(data) if settings.initial == "auto" else None
    start = choose_start(data, settings.initial) if start is None else start
    start, rejected = reject_outliers(data, start, report)
    kept = data.without(rejected)
    check_determined(kept)
    return Solution(data, Descent(kept, settings.max_iterations, settings.tolerance, report)(start), rejected)


def _replayed(data: GraphData, settings: Settings, report: Progress) -> Solved:
    from hybridlio.graph.solve.replay import replay

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


def choose_start(data: GraphData, initial: str) -> Array:
    """Where to start from: ``given`` initial values, those found in one way, or (``auto``) the best of several.

    These are the given values, chordal ones, and chordal ones without the factors that have a robust kernel.
    Given values that fit about as well as they ever can are taken as they are.

    Raises:
        GraphError: values are missing and cannot be found.
    """
    if initial in METHODS:
        return find(data, initial)
    start = data.initial_coordinates()
    if initial == "given":
        if start is None:
            missing = [key for key in data.keys if data.coordinates(key) is None]
            raise GraphError(f"pose {named(missing)} has no initial value; give one, or choose initial='auto'")
        return start
    edges = edges_of(data)
    if start is not None and misfit(data, start, edges) <= _FITS * freedom(data):
        return start
    starts = [] if start is None else [start]
    for part in _parts_to_start_from(data):
        try:
            starts.append(find(part, "chordal", edges if part is data else None))
        except GraphError:  # parts that inertial factors or given values place
            if start is None:
                raise
    return starts[0] if len(starts) == 1 else min(starts, key=lambda poses: misfit(data, poses, edges))


def _parts_to_start_from(data: GraphData) -> list[GraphData]:
    """The whole graph, and the graph without robust edges where those that are left join the same poses."""
    if not data.edges.robust:
        return [data]
    sure = data.without(data.edges.robust)
    return [data, sure] if labels(sure, ("between",))[0] == labels(data, ("between",))[0] else [data]


def freedom(data: GraphData) -> int:
    """Measured numbers about poses less those to be found: what the misfit is when all is as it should be."""
    size = co.TANGENT_SIZE[data.dimension]
    others = sum(len(f.noise.values) for f in data.others.values() if f.noise and f.kind in ("prior", "gps"))
    return max(size * (len(data.edges) - len(data)) + others, 1)


def misfit(data: GraphData, coordinates: Array, edges: Edges) -> float:
    """Twice the error of between-factors, priors and GPS: enough to tell a good start from a bad one."""
    poses = co.to_matrices(coordinates)
    total = edges.loss(poses, data.edges.robust)
    for factor in data.others.values():
        if factor.kind in ("prior", "gps") and factor.noise is not None:
            residual = _absolute(factor, poses[data.places[factor.keys[0]]])
            squared = float(residual @ factor.noise.information @ residual)
            total += factor.robust.loss(squared) if factor.robust else squared
    return float(total)


def _absolute(factor: Factor, pose: Array) -> Array:
    """Residual of a prior or of GPS at a pose ``(4, 4)``."""
    if factor.kind == "gps":
        return np.asarray(se3.transform(pose, factor.measured[None, 3:])[0] - factor.measured[:3])
    step = se3.log(se3.between(co.to_matrices(factor.measured[None])[0], pose))
    return step if len(factor.measured) == 7 else step[2:5]


def silent(stage: str, iteration: int, error: float) -> None:
    """Report to nobody."""
    del stage, iteration, error
