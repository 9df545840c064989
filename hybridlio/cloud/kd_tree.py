"""The nearest of points that keep coming: a tree over most of them, and a small one over those that came since.

Making a tree of all points anew takes as long as looking for the neighbours of several scans. A few per cent of them
make one in a twentieth of the time; a search then goes through both trees, and finds what one of all would. Most
queries have none of the new points around and need not look there.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hybridlio.core.arrays import Array, Index

if TYPE_CHECKING:
    import small_gicp


_QUERIES_A_THREAD = 2000  # half a millisecond
_POINTS_A_THREAD = 10_000
_SIDE_M = 1.0  # more than most neighbours are away
_TABLE_CELLS = 1 << 23


class PointTree:
    """Finds nearest points.

    Args:
        points: ``(M, 3)`` metres, one at least; of all that :meth:`grown` adds, the first ones.
        threads: for building.
    """

    def __init__(self, points: Array, threads: int) -> None:
        self._old = build_tree(points, threads)
        self._settled, self._fresh = len(points), 0
        self._new: tuple[small_gicp.KdTree, _Surroundings] | None = None

    def __len__(self) -> int:
        return self._settled + self._fresh

    @property
    def fresh_share(self) -> float:
        """How many points there are beyond the large tree, for each in it."""
        return self._fresh / self._settled

    def grown(self, points: Array, threads: int) -> PointTree:
        """Of all ``points`` ``(N, 3)``, which begin with those of this one; it stays as it is, they share a tree."""
        other = object.__new__(PointTree)
        fresh = points[self._settled :]
        other._old, other._settled, other._fresh = self._old, self._settled, len(fresh)
        other._new = (build_tree(fresh, threads), _Surroundings(fresh)) if len(fresh) else None
        return other

    def nearest(self, queries: Array, threads: int) -> tuple[Index, Array]:
        """Index ``(N,)`` and squared distance ``(N,)`` of each query's nearest point."""
        index, nearest2, _ = self._search(queries, 1, threads)
        return index, nearest2

    def two_nearest(self, queries: Array, threads: int) -> tuple[Index, Array, Array]:
        """Index ``(N,)`` of the nearest, its squared distance ``(N,)``, and up to which ``(N,)`` there is no other.

        That is the second nearest's; where it is farther away than a metre it may be less, but not less than that.
        """
        return self._search(queries, 2, threads)

    def _search(self, queries: Array, count: int, threads: int) -> tuple[Index, Array, Array]:
        index, nearest2, second2 = _search(self._old, self._settled, queries, count, threads)
        if self._new is None:
            return index, nearest2, second2
        tree, surroundings = self._new
        asked = surroundings.may_matter(queries, nearest2)
        among, fresh2, next2 = _search(tree, self._fresh, queries.take(asked, axis=0), count, threads)
        old2, later2 = nearest2[asked], second2[asked]
        closer = fresh2 < old2
        index[asked] = np.where(closer, among + self._settled, index[asked])
        nearest2[asked] = np.minimum(old2, fresh2)
        second2 = np.minimum(second2, surroundings.side_m**2)  # nobody looked whether a new point lies beyond that
        second2[asked] = np.where(closer, np.minimum(old2, next2), np.minimum(later2, fresh2))
        return index, nearest2, second2


class _Surroundings:
    """The cubes in which there are points ``(M, 3)``, and those beside them."""

    def __init__(self, points: Array) -> None:
        columns = np.ascontiguousarray(points.T)  # along which a minimum is found ten times as quickly
        low, extent = columns.min(axis=1), columns.max(axis=1) - columns.min(axis=1)
        self.side_m = _SIDE_M
        while np.prod(extent / self.side_m + 6) > _TABLE_CELLS:
            self.side_m *= 2
        self._low = low - 2 * self.side_m
        self._most = np.floor(extent / self.side_m) + 4  # the outermost cubes stay empty
        nx, ny, nz = (int(n) + 1 for n in self._most)
        self._steps = (ny * nz, nz)
        self._table = np.zeros(nx * ny * nz, bool)
        beside = [x + y + z for x in (-ny * nz, 0, ny * nz) for y in (-nz, 0, nz) for z in (-1, 0, 1)]
        cubes = np.sort(self._cubes(points))
        occupied = cubes[np.diff(cubes, prepend=-1) > 0]
        self._table[np.add.outer(beside, occupied).ravel()] = True

    def may_matter(self, queries: Array, nearest2: Array) -> Index:
        """Which queries may have a point nearer than what they have; the others' are all a side away and more."""
        return np.flatnonzero(self._table.take(self._cubes(queries)) | (nearest2 > self.side_m**2))

    def _cubes(self, points: Array) -> Index:
        x, y, z = np.clip((points - self._low) / self.side_m, 0, self._most).astype(np.int64).T
        return np.asarray(x * self._steps[0] + y * self._steps[1] + z)


def threads_for(queries: int, most: int) -> int:
    """So many as gain more than waiting for each other costs, which on a busy machine is milliseconds."""
    return max(1, min(most, queries // _QUERIES_A_THREAD))


def build_tree(points: Array, threads: int) -> small_gicp.KdTree:
    """A tree of points ``(M, 3)``, by so many threads as are worth it."""
    import small_gicp  # what only trains a network does without

    return small_gicp.KdTree(points, max(1, min(threads, len(points) // _POINTS_A_THREAD)))


def _search(tree: small_gicp.KdTree, size: int, queries: Array, count: int, threads: int) -> tuple[Index, Array, Array]:
    """Index and squared distance of the nearest of ``size``, and of the second; infinite where it is not asked for."""
    index, distance2 = tree.batch_knn_search(queries, min(count, size), threads_for(len(queries), threads))
    second2 = distance2[:, 1].copy() if distance2.shape[1] > 1 else np.full(len(queries), np.inf)
    return index[:, 0].astype(np.int64), distance2[:, 0].copy(), second2
