"""Nearest neighbours among points that keep being added: a large tree, and a small one over the points added since.

Building a tree over all points takes as long as several scans' searches; one over the few per cent that a keyframe adds
takes a twentieth of that. A search goes through both trees and returns exactly what one tree over all points would.
Most queries have no added point in their surroundings and skip the small tree.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hybridlio.core.arrays import Array, Index

if TYPE_CHECKING:
    import small_gicp


# Work per thread that outweighs starting it and waiting for it, about half a millisecond of searching or building.
_QUERIES_PER_THREAD = 2000
_POINTS_PER_THREAD = 10_000
_BLOCK_SIDE_M = 1.0  # longer than most neighbour distances, so that few queries far from all added points are searched
_MAX_BLOCKS = 1 << 23  # 8 MiB of flags; above it blocks become coarser


class GrowingKdTree:
    """Finds nearest points; immutable, extended copies share the large tree.

    Args:
        points: ``(M, 3)`` metres, at least one. With ``base``, all points, beginning with those of its large tree.
        threads: for building.
        base: a tree whose large tree is used for its points instead of building one.
    """

    def __init__(self, points: Array, threads: int, base: GrowingKdTree | None = None) -> None:
        self._points, self._threads = points, threads
        if base is None:
            self._large, self._settled = build_tree(points, threads), len(points)
        else:
            self._large, self._settled = base._large, base._settled
        appended = points[self._settled :]
        self._appended = len(appended)
        self._small: tuple[small_gicp.KdTree, _Surroundings] | None = None
        if len(appended):
            self._small = (build_tree(appended, threads), _Surroundings(appended))

    def __getstate__(self) -> tuple[Array, int, int]:
        """Return what the trees are built from: points, number of those in the large tree, and threads."""
        return self._points, self._settled, self._threads

    def __setstate__(self, state: tuple[Array, int, int]) -> None:
        """Build the same trees again."""
        points, settled, threads = state
        self.__init__(points, threads, GrowingKdTree(points[:settled], threads))  # type: ignore[misc]

    def __len__(self) -> int:
        return self._settled + self._appended

    @property
    def appended_ratio(self) -> float:
        """Number of points outside the large tree over the number in it."""
        return self._appended / self._settled

    def extended(self, points: Array, threads: int) -> GrowingKdTree:
        """Return a tree over all ``points`` ``(N, 3)``, the first of which are this tree's; this tree is unchanged."""
        return GrowingKdTree(points, threads, base=self)

    def nearest(self, queries: Array, threads: int) -> tuple[Index, Array]:
        """Return index ``(N,)`` and squared distance ``(N,)`` of each query's nearest point."""
        index, nearest2, _ = self._search(queries, 1, threads)
        return index, nearest2

    def two_nearest(self, queries: Array, threads: int) -> tuple[Index, Array, Array]:
        """Return index ``(N,)`` and squared distance of the nearest point, and a lower bound of the second's ``(N,)``.

        The bound is exact up to a block's side, 1 m; beyond it the second nearest may be farther away than the bound.
        """
        return self._search(queries, 2, threads)

    def _search(self, queries: Array, count: int, threads: int) -> tuple[Index, Array, Array]:
        index, nearest2, second2 = _search(self._large, self._settled, queries, count, threads)
        if self._small is None:
            return index, nearest2, second2
        tree, surroundings = self._small
        asked = surroundings.may_matter(queries, nearest2)
        among, appended2, next2 = _search(tree, self._appended, queries.take(asked, axis=0), count, threads)
        large2, later2 = nearest2[asked], second2[asked]
        closer = appended2 < large2
        index[asked] = np.where(closer, among + self._settled, index[asked])
        nearest2[asked] = np.minimum(large2, appended2)
        second2 = np.minimum(second2, surroundings.side_m**2)  # beyond a block's side the small tree was not searched
        second2[asked] = np.where(closer, np.minimum(large2, next2), np.minimum(later2, appended2))
        return index, nearest2, second2


class _Surroundings:
    """The cubic blocks that hold points ``(M, 3)``, and the blocks beside them, as a table of flags."""

    def __init__(self, points: Array) -> None:
        columns = np.ascontiguousarray(points.T)  # reductions along contiguous rows are ten times as fast
        low, extent = columns.min(axis=1), columns.max(axis=1) - columns.min(axis=1)
        self.side_m = _BLOCK_SIDE_M
        while np.prod(extent / self.side_m + 6) > _MAX_BLOCKS:
            self.side_m *= 2
        self._low = low - 2 * self.side_m
        self._most = np.floor(extent / self.side_m) + 4  # the outermost blocks stay empty
        nx, ny, nz = (int(n) + 1 for n in self._most)
        self._strides = (ny * nz, nz)
        self._table = np.zeros(nx * ny * nz, bool)
        beside = [x + y + z for x in (-ny * nz, 0, ny * nz) for y in (-nz, 0, nz) for z in (-1, 0, 1)]
        blocks = np.sort(self._blocks(points))
        occupied = blocks[np.diff(blocks, prepend=-1) > 0]
        self._table[np.add.outer(beside, occupied).ravel()] = True

    def may_matter(self, queries: Array, nearest2: Array) -> Index:
        """Return the queries with a point that may be nearer than ``nearest2``; for the others all are a side away."""
        from hybridlio.cloud import voxel_loops  # late: compiled

        near = voxel_loops.flagged(queries, self._low, self.side_m, self._most, self._table)
        return np.flatnonzero(near | (nearest2 > self.side_m**2))

    def _blocks(self, points: Array) -> Index:
        x, y, z = np.clip((points - self._low) / self.side_m, 0, self._most).astype(np.int64).T
        return np.asarray(x * self._strides[0] + y * self._strides[1] + z)


def threads_for(queries: int, most: int) -> int:
    """Return how many threads pay off for a search; waiting for one on a busy machine costs milliseconds."""
    return max(1, min(most, queries // _QUERIES_PER_THREAD))


def build_tree(points: Array, threads: int) -> small_gicp.KdTree:
    """Build a tree over points ``(M, 3)`` with as many of the threads as pay off."""
    import small_gicp  # late: training does not need it

    return small_gicp.KdTree(points, max(1, min(threads, len(points) // _POINTS_PER_THREAD)))


def _search(tree: small_gicp.KdTree, size: int, queries: Array, count: int, threads: int) -> tuple[Index, Array, Array]:
    """Return the nearest of ``size`` points, its squared distance and the second's, infinite if not asked for."""
    index, distance2 = tree.batch_knn_search(queries, min(count, size), threads_for(len(queries), threads))
    second2 = distance2[:, 1].copy() if distance2.shape[1] > 1 else np.full(len(queries), np.inf)
    return index[:, 0].astype(np.int64), distance2[:, 0].copy(), second2
