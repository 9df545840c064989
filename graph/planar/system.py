"""Gauss-Newton's normal equations of a planar graph in NumPy and SuperLU.

GTSAM needs an object for each factor and value, made one by one from Python: 25 of the 200 ms that M3500 took. A step
takes 16 ms here and 24 there, on kitti_02, whose long chain needs QR there, 14 and 40. In space GTSAM's elimination is
the faster one: half of SuperLU's time on sphere2500. ``benchmarks/pose_graphs.py`` compares the whole.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu

from hybridlio.core.arrays import Array, Index, Mask
from hybridlio.graph.base.elimination import elimination_order
from hybridlio.graph.planar.edges import PlanarEdges, times


class PlanarSystem:
    """Gauss-Newton's normal equations over edges between poses, of which some are held.

    The pattern of the matrix is found once; each step fills in its numbers.

    Args:
        edges: of the graph.
        held: ``(N,)`` the poses that do not move.
    """

    def __init__(self, edges: PlanarEdges, held: Mask) -> None:
        self._edges, self._count = edges, len(held)
        self._order = elimination_order(held, edges.i, edges.j)
        place = np.full(len(held), -1, dtype=np.int64)
        place[self._order] = np.arange(len(self._order))
        i, j = place[edges.i], place[edges.j]
        self._free_i, self._free_j, self._both = i >= 0, j >= 0, (i >= 0) & (j >= 0)
        a, b, both = self._free_i, self._free_j, self._both
        every = np.arange(len(self._order))  # for the damping
        rows = np.concatenate([i[a], j[b], i[both], j[both], every])
        columns = np.concatenate([i[a], j[b], j[both], i[both], every])
        self._pattern = _Pattern(rows, columns, len(self._order))

    def step(self, poses: Array, information: Array | None = None, damping: float = 0.0) -> Array:
        """Return the Gauss-Newton step ``(3, N)`` of x y θ.

        Positions are unknowns in world, not in each pose's own frame: a chain of 5,000 poses then loses nothing to the
        squared condition number of normal equations, for which GTSAM's unknowns need QR.

        Args:
            poses: ``(3, N)``.
            information: ``(3, 3, M)`` other than the edges' own, such as weighted ones.
            damping: Levenberg's, added to the diagonal.

        Raises:
            RuntimeError: the system is singular.
        """
        edges = self._edges
        information = edges.information if information is None else information
        J_i, J_j = edges.jacobians(poses)
        weighted_i, weighted_j = times(information, J_i), times(information, J_j)
        a, b, both = self._free_i, self._free_j, self._both
        cross = times(np.swapaxes(J_i, 0, 1), weighted_j)[..., both]
        at_i, at_j = times(np.swapaxes(J_i, 0, 1), weighted_i), times(np.swapaxes(J_j, 0, 1), weighted_j)
        damped = np.broadcast_to(damping * np.eye(3)[..., None], (3, 3, len(self._order)))
        blocks = np.concatenate([at_i[..., a], at_j[..., b], cross, np.swapaxes(cross, 0, 1), damped], axis=2)
        solver = self._pattern.factorise(blocks)
        gradient = self._gradient(weighted_i, weighted_j, edges.residuals(poses))[:, self._order]
        step = np.zeros_like(poses)
        step[:, self._order] = -solver.solve(gradient.T.ravel()).reshape(-1, 3).T
        return step

    def _gradient(self, weighted_i: Array, weighted_j: Array, residual: Array) -> Array:
        """Return ``Jᵀ Ω r`` of each pose, ``(3, N)``."""
        ends = np.concatenate([self._edges.i, self._edges.j])
        pulls = [times(residual[None], weighted)[0] for weighted in (weighted_i, weighted_j)]
        return np.array([np.bincount(ends, row, self._count) for row in np.concatenate(pulls, axis=1)])


class _Pattern:
    """Where blocks of three by three lie in the columns of a square matrix of ``size`` blocks.

    Args:
        rows, columns: ``(K,)`` of the blocks; several at one place are added.
        size: number of blocks in a row.
    """

    def __init__(self, rows: Index, columns: Index, size: int) -> None:
        self._size = 3 * size
        distinct, block = np.unique(columns * size + rows, return_inverse=True)  # column by column
        column, row = np.divmod(distinct, size)
        count = np.bincount(column, minlength=size)
        first = np.cumsum(count) - count
        rank = np.arange(len(distinct)) - first[column]
        p, q = np.arange(3)[:, None, None], np.arange(3)[None, :, None]  # row and column in a block
        places = 9 * first[column] + 3 * rank + 3 * count[column] * q + p
        self._ends = np.concatenate([[0], np.cumsum(np.repeat(3 * count, 3))])
        self._rows = np.empty(9 * len(distinct), dtype=np.int32)
        self._rows[places] = np.broadcast_to(3 * row + p, places.shape)
        self._places = places[..., block].ravel()

    def factorise(self, blocks: Array) -> Any:
        """Return SuperLU's factorisation of the matrix of blocks ``(3, 3, K)``."""
        values = np.bincount(self._places, blocks.ravel(), len(self._rows))
        matrix = csc_matrix((values, self._rows, self._ends), (self._size, self._size))
        # panels of one column: in so sparse a matrix wider ones take a third longer
        options = {"SymmetricMode": True}
        return splu(matrix, permc_spec="NATURAL", diag_pivot_thresh=0.0, panel_size=1, options=options)
