"""Initial values from between-factors: along the odometry, along a spanning tree, or by chordal relaxation."""

from __future__ import annotations

from collections import deque
from typing import Literal, TypeAlias

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import ConfigError, GraphError
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.checks import groups, labels
from hybridlio.graph.model.edge_arrays import Edges, edges_of
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.model.keys import Key, named
from hybridlio.graph.model.measurements import Factor
from hybridlio.graph.solve.chordal import chordal

Method: TypeAlias = Literal["odometry", "spanning-tree", "chordal"]
METHODS = ("odometry", "spanning-tree", "chordal")
_FIXES_TO_ALIGN = 3
_FITS = 2.0  # times the degrees of freedom


def find(data: GraphData, method: str, edges: Edges | None = None) -> Array:
    """Coordinates ``(N, 7)`` or ``(N, 3)`` of all poses, in the graph's order; ``edges`` if they are known.

    Raises:
        ConfigError: unknown method.
        GraphError: some poses cannot be reached; names them.
    """
    if method not in METHODS:
        raise ConfigError(f"no way to initialise is called {method!r}; there are {', '.join(METHODS)}")
    edges, roots = edges or edges_of(data), find_roots(data)
    if method == "chordal":
        T = chordal(roots, len(data), edges)
    elif method == "spanning-tree":
        T = along_tree(data, edges, roots)
    else:
        T = along_tree(data, edges.where(edges.steps), roots)
    _align_to_gps(data, T)
    return co.from_matrices(T, data.dimension)


def find_roots(data: GraphData) -> dict[int, Array]:
    """For each group of poses joined by between-factors those that the others follow, and their poses ``(4, 4)``.

    All fixed poses; in a group without one, a pose with a prior, or else with an initial value, or else the first.

    Raises:
        GraphError: there are several groups and nothing says where one of them lies; a fixed pose lies nowhere.
    """
    index = data.places
    priors = {f.keys[0]: f.measured for f in data.others.values() if f.kind == "prior"}
    fixes = _gps_keys(data)
    parts = groups(data, ("between",))
    roots: dict[int, Array] = {}
    for key in data.fixed:
        if (initial := data.initial(key)) is None:
            raise GraphError(f"pose {key} is fixed but has no initial value; give one")
        roots[index[key]] = initial
    for part in parts:
        if not data.fixed.isdisjoint(part):
            continue
        key = min(part, key=lambda key: (key not in priors, data.coordinates(key) is None))
        initial = data.initial(key)
        if key in priors:
            initial = co.to_matrices(priors[key][None])[0]
        if initial is None and len(parts) > 1 and len(fixes & set(part)) < _FIXES_TO_ALIGN:
            raise GraphError(f"nothing says where pose {named(part)} may lie; give an initial value")
        roots[index[key]] = np.eye(4) if initial is None else initial
    return roots


def along_tree(data: GraphData, edges: Edges, roots: dict[int, Array]) -> Array:
    """Poses ``(N, 4, 4)`` by following the edges breadth first from the roots.

    Raises:
        GraphError: some poses are not reached; names them.
    """
    T = np.zeros((len(data), 4, 4))
    steps: list[list[tuple[int, Array]]] = [[] for _ in range(len(data))]
    for i, j, forth, back in zip(edges.i, edges.j, edges.T, se3.inverse(edges.T), strict=True):
        steps[i].append((j, forth))
        steps[j].append((i, back))
    reached = np.zeros(len(data), dtype=bool)
    for k, root in roots.items():
        T[k], reached[k] = root, True
    queue = deque(roots)
    while queue:
        i = queue.popleft()
        for j, step in steps[i]:
            if not reached[j]:
                T[j], reached[j] = T[i] @ step, True
                queue.append(j)
    if not reached.all():
        missing = [key for key, there in zip(data.keys, reached, strict=True) if not there]
        raise GraphError(f"no chain of such factors leads to pose {named(missing)}; initialise otherwise")
    return se3.orthonormalise(T)


def _gps_keys(data: GraphData) -> set[Key]:
    return {factor.keys[0] for factor in data.others.values() if factor.kind == "gps"}


def _align_to_gps(data: GraphData, T: Array) -> None:
    """Move each group that only GPS places onto its fixes, as a whole (Umeyama, without scale)."""
    fixes = [factor for factor in data.others.values() if factor.kind == "gps"]
    if not fixes:
        return
    index = data.places
    placed = {f.keys[0] for f in data.others.values() if f.kind == "prior"} | data.fixed
    for part in groups(data, ("between",)):
        inside = set(part)
        here = [factor for factor in fixes if factor.keys[0] in inside]
        if inside & placed or len(here) < _FIXES_TO_ALIGN or any(data.coordinates(key) is not None for key in part):
            continue
        poses = T[[index[factor.keys[0]] for factor in here]]
        measured = np.array([factor.measured for factor in here])
        antennas = (poses[:, :3, :3] @ measured[:, 3:, None])[..., 0] + poses[:, :3, 3]
        places = [index[key] for key in part]
        T[places] = _rigid_fit(antennas, measured[:, :3]) @ T[places]


def _rigid_fit(points: Array, onto: Array) -> Array:
    """``(4, 4)`` that brings points ``(N, 3)`` closest to others."""
    a, b = points - points.mean(axis=0), onto - onto.mean(axis=0)
    U, _, Vt = np.linalg.svd(b.T @ a)
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return se3.make(R, onto.mean(axis=0) - R @ points.mean(axis=0))


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
