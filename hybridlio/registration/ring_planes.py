"""Planes across keyframes, for points whose neighbours in their own scan are all of one beam.

A sensor of 16 beams sees the ground beyond 10 m in rings that lie metres apart. In its own scan such a ring has no
plane, and without it little tells the pitch. The next keyframes' rings lie between them: two metres on, so far apart.
"""

from __future__ import annotations

import numpy as np

from hybridlio.cloud.kd_tree import build_tree, threads_for
from hybridlio.cloud.plane_fitting import LEAST_NEIGHBOURS, Fitted, fit_planes
from hybridlio.core.arrays import Array, Index

_KEYFRAMES = 5
_NEIGHBOURS = 15
_REACH_M = 4.0  # of neighbours: a ring alone has fewer so near, and a larger piece of ground is not plane
_BREADTH_M = 0.25  # of several rings; a single one is as broad as the noise of a range


class LoosePoints:
    """The last keyframes' points without planes of their own scan, map frame; starts empty."""

    def __init__(self) -> None:
        self._recent: list[Array] = []

    def take_in(self, points: Array, threads: int) -> tuple[Index, Fitted]:
        """Add a keyframe's points ``(N, 3)``.

        Returns:
            which of them have neighbours, of this keyframe or of the last ones, that make a plane; and their planes.
        """
        self._recent = [*self._recent, points][-_KEYFRAMES:]
        everything = np.concatenate(self._recent)
        if len(everything) < LEAST_NEIGHBOURS or not len(points):
            return np.empty(0, np.intp), fit_planes(np.empty((0, LEAST_NEIGHBOURS, 3)))
        count, worth = min(_NEIGHBOURS, len(everything)), threads_for(2 * len(points), threads)
        index, distance2 = build_tree(everything, threads).batch_knn_search(points, count, worth)
        near = np.flatnonzero(distance2[:, -1] < _REACH_M**2)
        fitted = fit_planes(everything.take(index[near], axis=0))
        broad = fitted.breadth_m > _BREADTH_M
        return near[broad], Fitted(*(column[broad] for column in fitted))
