"""Between-factors as arrays, for what is computed on all of them at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridlio import se3
from hybridlio.estimates import Array
from hybridlio.graph import coordinates as co
from hybridlio.graph.graph_data import GraphData
from hybridlio.graph.measurements import Factor


@dataclass(frozen=True, eq=False)
class Edges:
    """Between-factors as arrays.

    Attributes:
        i, j: ``(M,)`` places of the poses in the graph's order.
        T: ``(M, 4, 4)``.
        information: ``(M, 6, 6)``, in the plane ``(M, 3, 3)``; rotation first.
        steps: ``(M,)`` whether the edge joins consecutive keys.
    """

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

    def where(self, keep: NDArray[np.bool_]) -> Edges:
        """Those to keep."""
        return Edges(self.i[keep], self.j[keep], self.T[keep], self.information[keep], self.steps[keep])


def edges_of(data: GraphData) -> Edges:
    """All between-factors of a graph, in its order."""
    factors = [factor for factor in data.factors.values() if factor.kind == "between"]
    index = {key: k for k, key in enumerate(data.keys)}
    ends = np.array([(index[f.keys[0]], index[f.keys[1]]) for f in factors], dtype=np.int64).reshape(-1, 2)
    measured = np.array([factor.measured for factor in factors]).reshape(-1, len(co.IDENTITY[data.dimension]))
    size = co.TANGENT_SIZE[data.dimension]
    information = np.array([factor.noise.information for factor in factors if factor.noise is not None])
    i, j = ends[:, 0], ends[:, 1]
    robots, numbers = (
        np.array([(-1, k) if isinstance(k, int) else k for k in data.keys], dtype=np.int64).reshape(-1, 2).T
    )
    steps = (robots[i] == robots[j]) & (np.abs(numbers[i] - numbers[j]) == 1)
    return Edges(i, j, co.to_matrices(measured), information.reshape(-1, size, size), steps)


def is_step(factor: Factor) -> bool:
    """Whether the factor joins consecutive keys (of one robot): a step of odometry, not a loop."""
    if factor.kind != "between":
        return False
    i, j = factor.keys
    if isinstance(i, tuple) and isinstance(j, tuple):
        return i[0] == j[0] and abs(i[1] - j[1]) == 1
    return isinstance(i, int) and isinstance(j, int) and abs(i - j) == 1
