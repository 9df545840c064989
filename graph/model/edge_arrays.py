"""Between-factors as matrices, for computations on all of them at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Index, Mask
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.model.keys import Key
from hybridlio.graph.model.noise import Robust


@dataclass(frozen=True, eq=False)
class Edges:
    """Between-factors as arrays.

    Attributes:
        ids: factor ids ``(M,)``.
        i, j: indices ``(M,)`` of the poses in the graph's order.
        T: measured ``T_i_j`` ``(M, 4, 4)``.
        information: ``(M, 6, 6)``, or ``(M, 3, 3)`` in the plane; rotation first.
        consecutive: ``(M,)`` whether the edge joins consecutive keys of one robot: odometry, not a loop.
    """

    ids: Index
    i: Index
    j: Index
    T: Array
    information: Array
    consecutive: Mask

    @property
    def planar(self) -> bool:
        """Whether the graph is planar."""
        return bool(self.information.shape[1] == 3)

    def weights(self) -> tuple[Array, Array]:
        """Return the mean information of rotation and of position, ``(M,)`` each."""
        diagonal = np.diagonal(self.information, axis1=1, axis2=2)
        rotations = diagonal.shape[1] // 2  # one of three in the plane, three of six in space
        return diagonal[:, :rotations].mean(axis=1), diagonal[:, rotations:].mean(axis=1)

    def chi2(self, poses: Array) -> Array:
        """Return χ² ``(M,)`` of the edges at poses ``(N, 4, 4)``."""
        error = se3.between(self.T, se3.between(poses[self.i], poses[self.j]))
        residual = _planar_log(error) if self.planar else se3.log(error)
        return np.asarray(np.einsum("mi,mij,mj->m", residual, self.information, residual))

    def loss(self, poses: Array, robust: dict[int, Robust]) -> float:
        """Return the sum of χ² at poses ``(N, 4, 4)``, with the kernels of the edges that have one, by id."""
        chi2 = self.chi2(poses)
        for factor_id, kernel in robust.items():
            row = int(np.searchsorted(self.ids, factor_id))
            chi2[row] = kernel.loss(float(chi2[row]))
        return float(chi2.sum())

    def where(self, keep: Mask) -> Edges:
        """Return some of the edges."""
        return Edges(
            self.ids[keep], self.i[keep], self.j[keep], self.T[keep], self.information[keep], self.consecutive[keep]
        )  # fmt: skip


def _planar_log(T: Array) -> Array:
    """Return tangent vectors ``(M, 3)`` of heading, x, y of poses ``(M, 4, 4)`` in the plane.

    As :func:`hybridlio.core.se3.log`, in a fifth of its time.
    """
    x, y, angle = co.from_matrices(T, 2).T
    half = angle / 2
    c = half / np.tan(np.where(half == 0, 1.0, half))
    c = np.where(half == 0, 1.0, c)
    return np.column_stack([angle, c * x + half * y, c * y - half * x])


def edges_of(data: GraphData) -> Edges:
    """Return all between-factors of a graph, in its order."""
    table = data.edges
    i, j = table.ends.T
    consecutive = joins_consecutive(data.keys, table.ends)
    return Edges(table.ids, i, j, co.to_matrices(table.measured), table.information, consecutive)


def consecutive(i: Key, j: Key) -> bool:
    """Whether two keys follow each other on one robot."""
    (robot, a), (other, b) = ((-1, key) if isinstance(key, int) else key for key in (i, j))
    return robot == other and abs(a - b) == 1


def joins_consecutive(keys: list[Key], ends: Index) -> Mask:
    """Return which edges ``(M, 2)`` join consecutive keys of one robot."""
    pairs = [(-1, key) if isinstance(key, int) else key for key in keys]
    robots, numbers = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    i, j = ends.T
    return np.asarray((robots[i] == robots[j]) & (np.abs(numbers[i] - numbers[j]) == 1))


def loops_of(data: GraphData) -> list[int]:
    """Return the ids of the between-factors of keys that are not consecutive."""
    found: list[int] = data.edges.ids[~joins_consecutive(data.keys, data.edges.ends)].tolist()
    return found
