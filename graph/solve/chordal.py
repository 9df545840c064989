"""Chordal initialisation: all rotations by relaxed linear least squares, then all positions.

Carlone, Tron, Daniilidis, Dellaert, "Initialization techniques for 3D SLAM: a survey on rotation estimation and its use
in pose graph optimization" (ICRA 2015), section III.B; after Martinec and Pajdla (CVPR 2007).

GTSAM's ``InitializePose3`` weighs all edges alike; this weighs them by their information, and takes a fifth to a third
of its time. Errors of the start, and of the optimum: sphere2500 840 against 2,066 (676), parking-garage 0.7 against 471
(0.6), torus3D 12,339 against 12,388 (12,118).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.linalg import splu

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Index
from hybridlio.core.errors import GraphError
from hybridlio.graph.base.elimination import elimination_order
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.edge_arrays import Edges


def chordal_poses(roots: dict[int, Array], count: int, edges: Edges) -> Array:
    """Return poses ``(count, 4, 4)`` that fit the edges, with each root held at its pose ``(4, 4)``.

    Raises:
        GraphError: some pose is joined to no root.
    """
    T = np.tile(np.eye(4), (count, 1, 1))
    for k, root in roots.items():
        T[k] = root
    known = np.zeros(count, dtype=bool)
    known[list(roots)] = True
    if len(edges.i) and not known.all():
        rotation_weights, position_weights = edges.weights()
        order = elimination_order(known, edges.i, edges.j)
        T[:, :3, :3] = _rotations(T, order, edges, rotation_weights)
        T[:, :3, 3] = _positions(T, order, edges, position_weights)
    return T


def _rotations(T: Array, order: Index, edges: Edges, weights: Array) -> Array:
    """Solve ``R_i R_ij = R_j`` over all matrices, then return the nearest rotations ``(N, 3, 3)``."""
    d = 2 if edges.planar else 3
    count, m = len(T), len(edges.i)
    root = np.sqrt(weights / weights.mean())
    row, column = np.indices((d, d))
    # The unknowns are the transposes, stacked to (d·N, d): R_ijᵀ R_iᵀ − R_jᵀ = 0 is linear in them, d rows per edge.
    rows = (d * np.arange(m)[:, None, None] + row).ravel()
    columns = (d * edges.i[:, None, None] + column).ravel()
    values = (root[:, None, None] * np.swapaxes(edges.T[:, :d, :d], 1, 2)).ravel()
    rows_j = (d * np.arange(m)[:, None] + np.arange(d)).ravel()
    columns_j = (d * edges.j[:, None] + np.arange(d)).ravel()
    A = csr_matrix(
        (np.r_[values, -np.repeat(root, d)], (np.r_[rows, rows_j], np.r_[columns, columns_j])), (d * m, d * count)
    )
    given = np.swapaxes(T[:, :d, :d], 1, 2).reshape(d * count, d)
    solved = _solve(A, np.zeros((d * m, d)), given, _blocks(order, d)).reshape(count, d, d)
    return _nearest_rotations(np.swapaxes(solved, 1, 2))


def _nearest_rotations(matrices: Array) -> Array:
    """Return the rotations ``(N, 3, 3)`` nearest to matrices ``(N, 3, 3)``, or ``(N, 2, 2)`` of the plane."""
    if matrices.shape[1] == 3:
        return np.asarray(se3.orthonormalise(se3.make(matrices, np.zeros(3)))[:, :3, :3])
    heading = np.arctan2(matrices[:, 1, 0] - matrices[:, 0, 1], matrices[:, 0, 0] + matrices[:, 1, 1])
    planar = np.column_stack([np.zeros((len(heading), 2)), heading])
    return np.asarray(co.to_matrices(planar)[:, :3, :3])


def _blocks(order: Index, size: int) -> Index:
    """Return the places of unknowns that come in blocks of a size, from those of the blocks."""
    return np.asarray((size * order[:, None] + np.arange(size)).ravel())


def _positions(T: Array, order: Index, edges: Edges, weights: Array) -> Array:
    """Solve ``t_j − t_i = R_i t_ij`` with the rotations of ``T`` for positions ``(N, 3)``."""
    m = len(edges.i)
    root = np.sqrt(weights / weights.mean())
    row = np.arange(m)
    A = csr_matrix((np.r_[-root, root], (np.r_[row, row], np.r_[edges.i, edges.j])), (m, len(T)))
    steps = (T[edges.i, :3, :3] @ edges.T[:, :3, 3, None])[..., 0]
    return _solve(A, root[:, None] * steps, T[:, :3, 3], order)


def _solve(A: Any, b: Array, given: Array, order: Index) -> Array:
    """Solve least squares ``A x = b`` for the rows ``order`` of ``x``, in this order, with the others as ``given``."""
    x = given.copy()
    x[order] = 0.0
    rest, free = b - A @ x, A[:, order]
    options = {"SymmetricMode": True}  # with the threshold below: sparse Cholesky by SuperLU
    try:
        normal = splu((free.T @ free).tocsc(), permc_spec="NATURAL", diag_pivot_thresh=0.0, options=options)
    except RuntimeError as error:
        raise GraphError(f"chordal initialisation: some pose is joined to no root ({error})") from error
    x[order] = normal.solve(free.T @ rest)
    return x
