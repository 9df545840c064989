"""Initial values of poses: along the odometry, along a spanning tree, by chordal relaxation, or the best of several."""

from __future__ import annotations

from collections import deque

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import GraphError
from hybridlio.graph.calibration.plain_steps import with_plain_steps
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.connectivity import group_labels, groups
from hybridlio.graph.model.edge_arrays import Edges, edges_of
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.model.keys import Key, list_keys
from hybridlio.graph.model.measurements import Factor
from hybridlio.graph.solve.chordal import chordal_poses
from hybridlio.graph.solve.online_start import follow_factors
from hybridlio.graph.solve.settings import INITIAL_METHODS, check_choice

_FIXES_TO_ALIGN = 3  # positions that determine a rigid transform, if they are not on one line
# χ² per degree of freedom up to which given initial values count as good, which saves the search for better ones. It is
# 1 at the optimum of consistent factors; 2 allows for noise that was stated half as large as it is.
_GOOD_CHI2_PER_FREEDOM = 2.0


def choose_start(data: GraphData, initial: str) -> Array:
    """Return the coordinates ``(N, 7)`` or ``(N, 3)`` that a solver starts from.

    Args:
        data: the graph.
        initial: ``given``; one of :data:`INITIAL_METHODS`; or ``auto``, the start of smallest error among the given
            values, chordal ones, and chordal ones without the factors that have a robust kernel. Given values that
            already fit well are taken without a search. Where parts of the graph are joined by inertial samples alone,
            the start follows all factors, as an online solver's does.

    Raises:
        GraphError: values are missing and cannot be found, or a fixed pose has none.
    """
    _fixed_poses(data)
    if initial in INITIAL_METHODS:
        return find_initial_values(with_plain_steps(data), initial)
    data = with_plain_steps(data)
    values = data.initial_values
    missing = np.isnan(values[:, 0])
    if initial == "given":
        if missing.any():
            keys = data.keys_at(np.flatnonzero(missing).tolist())
            raise GraphError(f"pose {list_keys(keys)} has no initial value; give one, or choose initial='auto'")
        return values
    given = None if missing.any() else values
    edges = edges_of(data)
    if given is not None and _chi2(data, given, edges) <= _GOOD_CHI2_PER_FREEDOM * _degrees_of_freedom(data):
        return given
    starts = [] if given is None else [given]
    for part in _graphs_to_relax(data):
        try:
            starts.append(find_initial_values(part, "chordal", edges if part is data else None))
        except GraphError:  # a part that only inertial factors or given values place
            if given is None:
                starts.append(follow_factors(part))
    return starts[0] if len(starts) == 1 else min(starts, key=lambda poses: _chi2(data, poses, edges))


def find_initial_values(data: GraphData, method: str, edges: Edges | None = None) -> Array:
    """Return coordinates ``(N, 7)`` or ``(N, 3)`` of all poses, found from the between-factors.

    Args:
        data: the graph.
        method: one of :data:`INITIAL_METHODS`.
        edges: of the graph, where the caller has them already.

    Raises:
        ConfigError: unknown method.
        GraphError: some poses cannot be reached; names them.
    """
    check_choice("initialisation", method, INITIAL_METHODS)
    edges, roots = edges or edges_of(data), _find_roots(data)
    if method == "chordal":
        T = chordal_poses(roots, len(data), edges)
    elif method == "spanning-tree":
        T = _along_tree(data, edges, roots)
    else:
        T = _along_tree(data, edges.where(edges.consecutive), roots)
    _align_to_gps(data, T)
    return co.from_matrices(T, data.dimension)


def _find_roots(data: GraphData) -> dict[int, Array]:
    """Return the poses ``(4, 4)`` that the others are placed from, by index.

    These are all fixed poses, and in each group of poses without one: a pose with a prior, else one with an initial
    value, else the first, at the identity.

    Raises:
        GraphError: a fixed pose has no initial value, or there are several groups and one has neither prior, initial
            value nor enough GPS fixes.
    """
    priors = {f.keys[0]: f.measured for f in data.other_factors.values() if f.kind == "prior"}
    gps_keys = {factor.keys[0] for factor in data.other_factors.values() if factor.kind == "gps"}
    parts = groups(data, ("between",))
    roots = _fixed_poses(data)
    for part in parts:
        if not data.fixed.isdisjoint(part):
            continue
        key = min(part, key=lambda key: (key not in priors, data.initial_value(key) is None))
        root = co.to_matrices(priors[key][None])[0] if key in priors else _initial_pose(data, key)
        if root is None and len(parts) > 1 and len(gps_keys & set(part)) < _FIXES_TO_ALIGN:
            raise GraphError(f"no factor places pose {list_keys(part)}; give an initial value")
        roots[data.index[key]] = np.eye(4) if root is None else root
    return roots


def _fixed_poses(data: GraphData) -> dict[int, Array]:
    """Return the fixed poses ``(4, 4)`` by index; raise GraphError where one has no initial value."""
    found: dict[int, Array] = {}
    for key in data.fixed:
        if (fixed := _initial_pose(data, key)) is None:
            raise GraphError(f"pose {key} is fixed but has no initial value; give one by set_initial")
        found[data.index[key]] = fixed
    return found


def _initial_pose(data: GraphData, key: Key) -> Array | None:
    coordinates = data.initial_value(key)
    return None if coordinates is None else np.asarray(co.to_matrices(coordinates[None])[0])


def _along_tree(data: GraphData, edges: Edges, roots: dict[int, Array]) -> Array:
    """Return poses ``(N, 4, 4)`` by following the edges breadth first from the roots.

    Raises:
        GraphError: some poses are not reached; names them.
    """
    T = np.zeros((len(data), 4, 4))
    steps: list[list[tuple[int, Array]]] = [[] for _ in range(len(data))]
    for i, j, forward, backward in zip(edges.i, edges.j, edges.T, se3.inverse(edges.T), strict=True):
        steps[i].append((j, forward))
        steps[j].append((i, backward))
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
        missing = data.keys_at(np.flatnonzero(~reached).tolist())
        raise GraphError(f"no chain of these factors leads to pose {list_keys(missing)}; use another initialisation")
    return se3.orthonormalise(T)


def _align_to_gps(data: GraphData, T: Array) -> None:
    """Move each group of poses that only GPS places onto its fixes, as a rigid body (Umeyama, without scale)."""
    fixes = [factor for factor in data.other_factors.values() if factor.kind == "gps"]
    if not fixes:
        return
    placed = {f.keys[0] for f in data.other_factors.values() if f.kind == "prior"} | data.fixed
    for part in groups(data, ("between",)):
        inside = set(part)
        here = [factor for factor in fixes if factor.keys[0] in inside]
        if inside & placed or len(here) < _FIXES_TO_ALIGN or any(data.initial_value(key) is not None for key in part):
            continue
        poses = T[[data.index[factor.keys[0]] for factor in here]]
        measured = np.array([factor.measured for factor in here])
        antennas = (poses[:, :3, :3] @ measured[:, 3:, None])[..., 0] + poses[:, :3, 3]
        indices = [data.index[key] for key in part]
        T[indices] = _rigid_fit(antennas, measured[:, :3], data.dimension) @ T[indices]


def _rigid_fit(points: Array, onto: Array, d: int) -> Array:
    """Return the transform ``(4, 4)`` that brings points ``(N, 3)`` closest to others; in the plane for ``d`` of 2."""
    a, b = points - points.mean(axis=0), onto - onto.mean(axis=0)
    U, _, Vt = np.linalg.svd((b.T @ a)[:d, :d])
    R = np.eye(3)
    R[:d, :d] = U @ np.diag([*np.ones(d - 1), np.linalg.det(U @ Vt)]) @ Vt
    return se3.make(R, onto.mean(axis=0) - R @ points.mean(axis=0))


def _graphs_to_relax(data: GraphData) -> list[GraphData]:
    """Return the graph, and the graph without its robust edges where the remaining ones still join the same poses.

    Relaxation is linear least squares, so one wrong loop spoils it; edges that may be wrong usually have a kernel.
    """
    if not data.edges.robust:
        return [data]
    trusted = data.copy(without=data.edges.robust)
    same = group_labels(trusted, ("between",))[0] == group_labels(data, ("between",))[0]
    return [data, trusted] if same else [data]


def _degrees_of_freedom(data: GraphData) -> int:
    """Return the numbers that :func:`_chi2` sums over less those to be found: its expectation at the optimum."""
    absolute = (f for f in data.other_factors.values() if f.kind in ("prior", "gps"))
    measured = sum(len(f.noise.values) for f in absolute if f.noise)
    return max(data.tangent_size * (len(data.edges) - len(data)) + measured, 1)


def _chi2(data: GraphData, coordinates: Array, edges: Edges) -> float:
    """Return χ² of between-factors, priors and GPS under their kernels, to compare starts without building GTSAM's."""
    poses = co.to_matrices(coordinates)
    total = edges.loss(poses, data.edges.robust)
    for factor in data.other_factors.values():
        if factor.kind in ("prior", "gps") and factor.noise is not None:
            residual = _absolute_residual(factor, poses[data.index[factor.keys[0]]])
            squared = float(residual @ factor.noise.information @ residual)
            total += factor.robust.loss(squared) if factor.robust else squared
    return float(total)


def _absolute_residual(factor: Factor, pose: Array) -> Array:
    """Return the residual of a prior or a GPS factor at a pose ``(4, 4)``."""
    if factor.kind == "gps":
        apart = se3.transform(pose, factor.measured[None, 3:])[0] - factor.measured[:3]
        return np.asarray(apart if factor.noise is None else apart[: len(factor.noise.values)])
    step = se3.log(se3.between(co.to_matrices(factor.measured[None])[0], pose))
    return step if len(factor.measured) == 7 else step[2:5]
