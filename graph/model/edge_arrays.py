"""Between-factors as arrays, for what is computed on all of them at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.model.keys import Key
from hybridlio.graph.model.measurements import Robust


@dataclass(frozen=True, eq=False)
class Edges:
    """Between-factors as arrays.

    Attributes:
        ids: ``(M,)``.
        i, j: ``(M,)`` places of the poses in the graph's order.
        T: ``(M, 4, 4)``.
        information: ``(M, 6, 6)``, in the plane ``(M, 3, 3)``; rotation first.
        steps: ``(M,)`` whether the edge joins consecutive keys.
    """

    ids: NDArray[np.int64]
    i: NDArray[np.int64]
    j: NDArray[np.int64]
    T: Array
    information: Array
    steps: NDArray[np.bool_]

    @property
    def planar(self) -> bool:
        """Whether the graph lies in the plane."""
        return bool(self.information.shape[1] == 3)

    def weights(self) -> tuple[Array, Array]:
        """Mean information of rotation and of position, ``(M,)`` each."""
        diagonal = np.diagonal(self.information, axis1=1, axis2=2)
        rotations = diagonal.shape[1] // 2  # one of three in the plane, three of six in space
        return diagonal[:, :rotations].mean(axis=1), diagonal[:, rotations:].mean(axis=1)

    def chi2(self, poses: Array) -> Array:
        """χ² ``(M,)`` of the edges at poses ``(N, 4, 4)``."""
        residual = se3.log(se3.between(self.T, se3.between(poses[self.i], poses[self.j])))
        if self.planar:
            residual = residual[:, 2:5]
        return np.asarray(np.einsum("mi,mij,mj->m", residual, self.information, residual))

    def loss(self, poses: Array, robust: dict[int, Robust]) -> float:
        """Sum of χ² at poses ``(N, 4, 4)``, by the kernels of those ids that have one."""
        chi2 = self.chi2(poses)
        for number, kernel in robust.items():
            row = int(np.searchsorted(self.ids, number))
            chi2[row] = kernel.loss(float(chi2[row]))
        return float(chi2.sum())

    def where(self, keep: NDArray[np.bool_]) -> Edges:
        """Those to keep."""
        return Edges(self.ids[keep], self.i[keep], self.j[keep], self.T[keep], self.information[keep], self.steps[keep])


def edges_of(data: GraphData) -> Edges:
    """All between-factors of a graph, in its order."""
    table = data.edges
    i, j = table.ends.T
    return Edges(table.ids, i, j, co.to_matrices(table.measured), table.information, steps_of(data.keys, table.ends))


def steps_of(keys: list[Key], ends: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which edges ``(M, 2)`` join consecutive keys (of one robot): steps of odometry, not loops."""
    pairs = [(-1, key) if isinstance(key, int) else key for key in keys]
    robots, numbers = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    i, j = ends.T
    return np.asarray((robots[i] == robots[j]) & (np.abs(numbers[i] - numbers[j]) == 1))


def loops_of(data: GraphData) -> list[int]:
    """Ids of the between-factors of keys that are not consecutive."""
    found: list[int] = data.edges.ids[~steps_of(data.keys, data.edges.ends)].tolist()
    return found
