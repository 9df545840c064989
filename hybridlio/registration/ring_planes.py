"""Planes across keyframes, for points whose neighbours in their own scan all belong to one ring.

A ring is what one beam draws on a surface. A 16-beam sensor sees the ground beyond 10 m in rings that are metres apart.
In its own scan such a ring has no plane, and without distant ground the pitch is poorly constrained. The rings of the
next keyframes, each 2 m farther on, fall between them, and together they make planes.
"""

from __future__ import annotations

import numpy as np

from hybridlio.cloud.kd_tree import build_tree, threads_for
from hybridlio.cloud.plane_fitting import MIN_NEIGHBOURS, FittedPlanes, fit_planes
from hybridlio.core.arrays import Array, Index

_KEYFRAMES = 5  # whose points are kept: at 2 m each, their rings cover the gap between two rings at 20 m
_NEIGHBOURS = 15  # half more than for a plane in one scan, so that a ring's own points do not fill them all
# Distance of the farthest neighbour, in sides of a map cell: 4 m of cells of 2 m. A single ring has fewer points within
# it, and larger pieces of ground are not plane.
_MAX_DISTANCE = 2.0
# Smallest root mean square width of a plane, in sides of a map cell: 0.25 m of cells of 2 m. Points of one ring spread
# across it only by the noise of a range, about 0.03 m; two rings 1 m apart spread by 0.5 m.
_MIN_WIDTH = 0.125


class RingPlanes:
    """Fits planes to ring points of the last keyframes, map frame; starts empty.

    Args:
        side_m: of the map's cells.
    """

    def __init__(self, side_m: float) -> None:
        self._max_distance_m, self._min_width_m = _MAX_DISTANCE * side_m, _MIN_WIDTH * side_m
        self._recent: list[Array] = []

    def add_keyframe(self, points: Array, threads: int) -> tuple[Index, FittedPlanes]:
        """Add the ring points ``(N, 3)`` of a keyframe, map frame.

        Returns:
            indices ``(M,)`` of those whose neighbours, in this keyframe and the last ones, make a plane; and the
            planes.
        """
        self._recent = [*self._recent, points][-_KEYFRAMES:]
        everything = np.concatenate(self._recent)
        if len(everything) < MIN_NEIGHBOURS or not len(points):
            return np.empty(0, np.intp), fit_planes(np.empty((0, MIN_NEIGHBOURS, 3)))
        count, useful = min(_NEIGHBOURS, len(everything)), threads_for(2 * len(points), threads)
        index, distance2 = build_tree(everything, threads).batch_knn_search(points, count, useful)
        near = np.flatnonzero(distance2[:, -1] < self._max_distance_m**2)
        planes = fit_planes(everything.take(index[near], axis=0))
        wide = planes.width_m > self._min_width_m
        return near[wide], FittedPlanes(*(column[wide] for column in planes))
