"""Nearest neighbours among points that keep being added: a large tree, and a small one over the points added since.

Building a tree over all points takes as long as several scans' searches; one over the few per cent that a keyframe adds
takes a twentieth of that. A search goes through both trees and returns exactly what one tree over all points would.
Most queries have no added point in their surroundings and skip the small tree. In rooms most do not, maps are small and
searches many: there one tree is soon the cheaper.
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
# Points that a tree is built over in the time of one search: 0.15 to 0.4 µs each, and 0.35 to 0.7 µs.
_POINTS_PER_QUERY = 2
_BLOCK_SIDE_M = 1.0  # longer than most neighbour distances, so that few queries far from all added points are searched
_MAX_BLOCKS = 1 << 23  # 8 MiB of flags; above it blocks become coarser


class GrowingKdTree:
    """Finds nearest points; immutable, extended copies share the large tree.

    Searching the small tree as well makes every search longer. Once it has been asked so often that one tree over all
    points would have cost as much, the next extended copy has one.

    Args:
        points: ``(M, 3)`` metres, at least one. With ``base``, all points, beginning with those of its large tree.
        threads: for building.
        base: a tree whose large tree is used for its points instead of building one.
    """

    def __init__(self, points: Array, threads: int, base: GrowingKdTree | None = None) -> None:
        self._points, self._threads, self._asked = points, threads, 0
        self._first: int = len(points) if base is None else base._first
        if base is None or base._asked * _POINTS_PER_QUERY > len(points):
            self._large, self._settled = build_tree(points, threads), len(points)
        else:
            self._large, self._settled, self._asked = base._large, base._settled, base._asked
        appended = points[self._settled :]
        self._appended = len(appended)
        self._small: tuple[small_gicp.KdTree, _Surroundings] | None = None
        if len(appended):
            self._small = (build_tree(appended, threads), _Surroundings(appended))

    def __getstate__(self) -> tuple[Array, int, int, int]:
        """Return what the trees are built from: points, numbers of the first and in the large tree, and threads."""
        return self._points, self._first, self._settled, self._threads

    def __setstate__(self, state: tuple[Array, int, int, int]) -> None:
        """Build the same trees again."""
        points, first, settled, threads = state
        self.__init__(points, threads, GrowingKdTree(points[:settled], threads))  # type: ignore[misc]
        self._first = first

    def __len__(self) -> int:
        return len(self._points)

    @property
    def appended_ratio(self) -> float:
        """Number of points added by :meth:`extended` over the number before."""
        return (len(self) - self._first) / self._first

    def extended(self, points: Array, threads: int) -> GrowingKdTree:
        """Return a tree over all ``points`` ``(N, 3)``, the first of which are this tree's; this tree is unchanged."""
        return GrowingKdTree(points, threads, base=self)

    def nearest(self, queries: Array, threads: int) -> tuple[Index, Array]:
        """Return index ``(N,)`` and squared distance ``(N,)`` of each query's nearest point."""
        index, distance2, _ = self.several_nearest(queries, 1, threads)
        return index[:, 0].copy(), distance2[:, 0].copy()

    def several_nearest(self, queries: Array, count: int, threads: int) -> tuple[Index, Array, Array]:
        """Return each query's nearest points, and how near others may be.

        Args:
            queries: ``(N, 3)``.
            count: number K of points for each.
            threads: for the search.

        Returns:
            Index ``(N, K)`` and squared distance ``(N, K)``, in ascending order; the distance is infinite where there
            are fewer points. And a squared distance ``(N,)``, as far as which no other point lies: that of the last
            one, up to a block's side, 1 m. Beyond it only the first is certain to be the nearest.
        """
        index, distance2 = _search(self._large, self._settled, queries, count, threads)
        if self._small is None:
            return index, distance2, distance2[:, -1].copy()
        from hybridlio.cloud import voxel_loops  # late: compiled

        tree, surroundings = self._small
        asked = surroundings.may_matter(queries, distance2[:, 0])
        self._asked += len(asked)
        among, appended2 = _search(tree, self._appended, queries.take(asked, axis=0), count, threads)
        voxel_loops.merge(asked, index, distance2, among + self._settled, appended2)
        others2 = np.minimum(distance2[:, -1], surroundings.side_m**2)  # as far as the small tree was searched
        others2[asked] = distance2[asked, -1]
        return index, distance2, others2


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


def _search(tree: small_gicp.KdTree, size: int, queries: Array, count: int, threads: int) -> tuple[Index, Array]:
    """Return the nearest of ``size`` points ``(N, K)`` and their squared distances, infinite where there are fewer."""
    found, distance2 = tree.batch_knn_search(queries, min(count, size), threads_for(len(queries), threads))
    index = found.astype(np.int64)
    if size >= count:
        return index, distance2
    more = ((0, 0), (0, count - size))
    return np.pad(index, more), np.pad(distance2, more, constant_values=np.inf)
