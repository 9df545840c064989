"""Solving a pose graph: where to start, which solver, and what came out."""

from __future__ import annotations

from typing import Literal, TypeAlias

import numpy as np

from hybridlio import se3
from hybridlio.errors import ConfigError, GraphError
from hybridlio.estimates import Array
from hybridlio.graph import coordinates as co
from hybridlio.graph.checks import check_determined, labels
from hybridlio.graph.edges import Edges, edges_of
from hybridlio.graph.graph_data import GraphData
from hybridlio.graph.initial import find
from hybridlio.graph.keys import named
from hybridlio.graph.levenberg import Descent, Progress
from hybridlio.graph.measurements import Factor
from hybridlio.graph.solution import Solution

Solver: TypeAlias = Literal["auto", "batch", "gnc"]
SOLVERS = ("auto", "batch", "gnc")
_FITS = 2.0  # times the degrees of freedom


def optimise(
    graph: GraphData, solver: str, initial: str, max_iterations: int, tolerance: float, progress: Progress | None
) -> Solution:  # fmt: skip
    """Solve a pose graph; see :meth:`hybridlio.graph.pose_graph.PoseGraph.optimize`."""
    if solver not in SOLVERS or initial not in ("auto", "given") or max_iterations < 1 or not tolerance > 0:
        raise ConfigError(
            f"solver {solver!r}, initial {initial!r}, max_iterations {max_iterations}, tolerance {tolerance}: "
            f"solvers are {', '.join(SOLVERS)}, initial is auto or given, max_iterations at least 1, tolerance positive"
        )
    check_determined(graph)
    report = progress or _silent
    data = graph.without()
    if solver != "gnc":
        return Solution(data, Descent(data, max_iterations, tolerance, report)(choose_start(data, initial)))
    from hybridlio.graph.gnc import reject_outliers, start_without_loops

    start = start_without_loops(data) if initial == "auto" else None
    start, rejected = reject_outliers(data, choose_start(data, initial) if start is None else start, report)
    kept = data.without(rejected)
    check_determined(kept)
    return Solution(data, Descent(kept, max_iterations, tolerance, report)(start), rejected)


def choose_start(data: GraphData, initial: str) -> Array:
    """Where to start from: ``given`` initial values, or the best of several.

    These are the given values, chordal ones, and chordal ones without the factors that have a robust kernel.
    Given values that fit about as well as they ever can are taken as they are.

    Raises:
        GraphError: values are missing and cannot be found.
    """
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


def _silent(stage: str, iteration: int, error: float) -> None:
    """Report to nobody."""
    del stage, iteration, error
