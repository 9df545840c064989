"""The nearest of points that keep coming: a tree over most of them, and a small one over those that came since.

Making a tree of all points anew takes as long as looking for the neighbours of several scans. A few per cent of them
make one in a twentieth of the time; a search then goes through both trees, and finds what one of all would.
"""

from __future__ import annotations

import numpy as np
import small_gicp
from numpy.typing import NDArray

from hybridlio.estimates import Array

Index = NDArray[np.int64]

_QUERIES_A_THREAD = 2000  # half a millisecond
_POINTS_A_THREAD = 10_000


class PointTree:
    """Finds nearest points.

    Args:
        points: ``(M, 3)`` metres, one at least; of all that :meth:`grown` adds, the first ones.
        threads: for building.
    """

    def __init__(self, points: Array, threads: int) -> None:
        self._old = _tree(points, threads)
        self._settled, self._fresh = len(points), 0
        self._new: small_gicp.KdTree | None = None

    def __len__(self) -> int:
        return self._settled + self._fresh

    @property
    def fresh_share(self) -> float:
        """How many points there are beyond the large tree, for each in it."""
        return self._fresh / self._settled

    def grown(self, points: Array, threads: int) -> PointTree:
        """Of all ``points`` ``(N, 3)``, which begin with those of this one; it stays as it is, they share a tree."""
        other = object.__new__(PointTree)
        other._old, other._settled, other._fresh = self._old, self._settled, len(points) - self._settled
        other._new = _tree(points[self._settled :], threads) if other._fresh else None
        return other

    def nearest(self, queries: Array, threads: int) -> tuple[Index, Array]:
        """Index ``(N,)`` and squared distance ``(N,)`` of each query's nearest point."""
        index, distance2 = _search(self._old, queries, 1, threads)
        if self._new is None:
            return index[:, 0], distance2[:, 0]
        among, there2 = _search(self._new, queries, 1, threads)
        closer = there2[:, 0] < distance2[:, 0]
        return (
            np.where(closer, among[:, 0] + self._settled, index[:, 0]),
            np.where(closer, there2[:, 0], distance2[:, 0]),
        )

    def two_nearest(self, queries: Array, threads: int) -> tuple[Index, Array, Array]:
        """Index ``(N,)`` and squared distances ``(N,)`` of the nearest and the second; infinite without one."""
        index, (first2, second2) = _two(self._old, self._settled, queries, threads)
        if self._new is None:
            return index, first2, second2
        among, (fresh2, next2) = _two(self._new, self._fresh, queries, threads)
        closer = np.flatnonzero(fresh2 < first2)
        second2 = np.minimum(second2, fresh2)
        second2[closer] = np.minimum(first2[closer], next2[closer])
        index[closer] = among[closer] + self._settled
        first2[closer] = fresh2[closer]
        return index, first2, second2


def _tree(points: Array, threads: int) -> small_gicp.KdTree:
    return small_gicp.KdTree(points, max(1, min(threads, len(points) // _POINTS_A_THREAD)))


def _search(tree: small_gicp.KdTree, queries: Array, count: int, threads: int) -> tuple[Index, Array]:
    """With so many threads as gain more than waiting for each other costs, which on a busy machine is milliseconds."""
    worth = max(1, min(threads, len(queries) // _QUERIES_A_THREAD))
    index, distance2 = tree.batch_knn_search(queries, count, worth)
    return index.view(np.int64), distance2


def _two(tree: small_gicp.KdTree, size: int, queries: Array, threads: int) -> tuple[Index, tuple[Array, Array]]:
    index, distance2 = _search(tree, queries, min(2, size), threads)
    first2 = np.ascontiguousarray(distance2[:, 0])
    second2 = np.full(len(queries), np.inf) if size < 2 else np.ascontiguousarray(distance2[:, 1])
    return np.ascontiguousarray(index[:, 0]), (first2, second2)
