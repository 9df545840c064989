"""Points with planes, and how far the points of a scan lie from them: what registration brings to a minimum."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridlio.cloud.kd_tree import PointTree
from hybridlio.core.arrays import Array
from hybridlio.registration.information import NORMAL_NOISE, NORMAL_NOISE_OF_THIN, lever_arms


@dataclass(frozen=True, eq=False)
class System:
    """The weighted least squares of one Gauss-Newton step, right perturbation.

    Attributes:
        hessian, gradient: ``(6, 6)`` and ``(6,)`` of half the weighted squared distances.
        distances: ``(N,)`` of the points to their planes, metres.
        weights: ``(N,)``, between 0 and 1.
    """

    hessian: Array
    gradient: Array
    distances: Array
    weights: Array


@dataclass(frozen=True, eq=False)
class Matches:
    """Points of a scan and the planes that they lie nearest to, at the pose at which they were looked for.

    Attributes:
        pose: ``(4, 4)`` that pose.
        source: ``(N, 3)`` the points, scan frame.
        planes: ``(N, 5)`` normal n, n·v of any point v in the plane, and how much it counts, of :class:`Surface`.
        rows: ``(7, N)`` derivatives of the distances by a right perturbation of the pose, and the distances.
    """

    pose: Array
    source: Array
    planes: Array
    rows: Array

    @classmethod
    def of(cls, pose: Array, source: Array, planes: Array) -> Matches:
        """Linearised at ``pose``."""
        normals = planes[:, :3]
        x, y, z = source.T
        a, b, c = (normals @ pose[:3, :3]).T  # the normals in the scan's frame
        rows = np.empty((7, len(source)))
        rows[0], rows[1], rows[2] = y * c - z * b, z * a - x * c, x * b - y * a
        rows[3], rows[4], rows[5] = a, b, c
        rows[6] = x * a + y * b + z * c + normals @ pose[:3, 3] - planes[:, 3]
        return cls(pose, source, planes, rows)

    def __len__(self) -> int:
        return len(self.source)

    @property
    def levers_m(self) -> Array:
        """``(3,)`` of the points about the scan's axes, see :func:`hybridlio.registration.information.lever_arms`."""
        return lever_arms(self.source)

    def system(self, kernel_m: float, xi: Array | None = None) -> System:
        """The step's equations under the Geman-McClure kernel, at the pose or a small way ``xi`` ``(6,)`` from it.

        On the way the distances are linear: after a milliradian and 50 m that is off by a twentieth of a millimetre.
        """
        distances = self.rows[6] if xi is None else self.rows[6] + xi @ self.rows[:6]
        weights = self.planes[:, 4] * (kernel_m**2 / (kernel_m**2 + distances * distances)) ** 2
        weighted = self.rows[:6] * weights
        return System(weighted @ self.rows[:6].T, weighted @ distances, distances, weights)


class Surface:
    """Points with normals and a tree over them: what a scan is registered to.

    Args:
        points: ``(M, 3)`` metres, one at least.
        normals: ``(M, 3)`` unit vectors.
        threads: for building the tree.
        weights: ``(M,)``, how much each plane counts, the less the thicker it is; by default 1.

    Attributes:
        normal_noise: what its normals pretend.
    """

    def __init__(self, points: Array, normals: Array, threads: int = 2, weights: Array | None = None) -> None:
        self.points = points
        self.normal_noise = NORMAL_NOISE if weights is None else NORMAL_NOISE_OF_THIN
        self._planes = _planes(points, normals, weights)
        self._tree = PointTree(points, threads)

    def grown(self, points: Array, normals: Array, threads: int = 2, weights: Array | None = None) -> Surface:
        """This one and more points after its own, for less than making it of all; it stays as it is."""
        other = object.__new__(Surface)
        other.points = np.concatenate([self.points, points])
        other.normal_noise = self.normal_noise
        other._planes = np.concatenate([self._planes, _planes(points, normals, weights)])
        other._tree = self._tree.grown(other.points, threads)
        return other

    @property
    def normals(self) -> Array:
        """``(M, 3)`` unit vectors."""
        return self._planes[:, :3]

    @property
    def fresh_share(self) -> float:
        """How many points came by :meth:`grown`, for each that was there before: with many, searches take longer."""
        return self._tree.fresh_share

    def nearest(self, queries: Array, threads: int) -> tuple[NDArray[np.int64], Array]:
        """Index ``(N,)`` and squared distance ``(N,)`` of each query's nearest point."""
        return self._tree.nearest(queries, threads)

    def two_nearest(self, queries: Array, threads: int) -> tuple[NDArray[np.int64], Array]:
        """Index ``(N,)`` of each query's nearest point, and how far the query may move so that it surely stays that.

        The way is half of what the second nearest is farther away; infinite of a surface of one point.
        """
        index, first2, second2 = self._tree.two_nearest(queries, threads)
        return index, (np.sqrt(second2) - np.sqrt(first2)) / 2

    def planes(self, index: NDArray[np.int64]) -> Array:
        """``(N, 5)`` of the points: normal n, n·v, and weight."""
        return self._planes.take(index, axis=0)  # much quicker than brackets


def _planes(points: Array, normals: Array, weights: Array | None) -> Array:
    weights = np.ones(len(points)) if weights is None else weights
    return np.column_stack([normals, np.einsum("ij,ij->i", normals, points), weights])


class Neighbours:
    """The nearest points of a surface to those of a scan, as the scan's pose changes.

    Searching a tree is what takes time. Where a point has not moved far enough for another neighbour to be nearer, none
    is looked for: after half a centimetre that are all but one in fifteen.

    Args:
        surface: where neighbours are.
        source: ``(N, 3)`` the scan's points, scan frame.
        threads: for the search.
    """

    def __init__(self, surface: Surface, source: Array, threads: int) -> None:
        self._surface, self._source, self._threads = surface, source, threads
        self._asked: Array | None = None  # (N, 3) where each point was when its neighbour was looked for
        self._free = np.empty(0)
        self._index = np.empty(0, np.int64)

    def matches(self, pose: Array, reach_m: float) -> Matches:
        """The planes of the points at a pose; points without a neighbour within reach are left out."""
        index, source = self.within(pose, reach_m)
        return Matches.of(pose, source, self._surface.planes(index))

    def within(self, pose: Array, reach_m: float) -> tuple[NDArray[np.int64], Array]:
        """Index ``(M,)`` of the neighbours within reach at a pose, and the points ``(M, 3)`` that have them."""
        moved = self._source @ pose[:3, :3].T + pose[:3, 3]
        self._look(moved)
        off = moved - self._surface.points.take(self._index, axis=0)
        near = np.flatnonzero(np.einsum("ij,ij->i", off, off) < reach_m**2)
        index, source = self._index, self._source
        if len(near) < len(source):
            index, source = index[near], source.take(near, axis=0)
        return index, source

    def _look(self, moved: Array) -> None:
        if self._asked is None:
            self._asked = moved
            self._index, self._free = self._surface.two_nearest(moved, self._threads)
            return
        way = moved - self._asked
        unsure = np.flatnonzero(np.einsum("ij,ij->i", way, way) >= self._free**2)
        if len(unsure):
            self._asked[unsure] = moved[unsure]
            self._index[unsure], self._free[unsure] = self._surface.two_nearest(moved[unsure], self._threads)
