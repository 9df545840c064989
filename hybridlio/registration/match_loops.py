"""The loops that match a scan's points with planes, compiled. Formulas are in :mod:`hybridlio.registration.surface`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hybridlio.cloud.compiled import compiled
from hybridlio.core.arrays import Array, Index

# Planes of this weight or more are thin: their thickness is below 5 cm, about twice the noise of a range (see the
# weight in hybridlio/cloud/plane_fitting.py). The others are bushes and the like, which have no front.
THIN_PLANE_WEIGHT = 0.9
# Sine of the angle under which the lidar may seem to be behind a plane that it sees: twice the usual tilt of normals,
# 0.045 rad (hybridlio/registration/information.py).
_LARGEST_FROM_BEHIND = 0.1


class Candidates(NamedTuple):
    """The points of a surface among which the nearest stays while a query moves.

    Attributes:
        nearest: ``(N, K)`` indices of the K nearest points of each query, the nearest first.
        own_m: ``(N,)`` how far the query may move with the same nearest point.
        reach_m: ``(N,)`` how far it may move with its nearest point among the K.
    """

    nearest: Index
    own_m: Array
    reach_m: Array


class Reach(NamedTuple):
    """Which neighbours count.

    Attributes:
        distance_m: how far they may be.
        aside_m: how far along their planes.
        one_sided: not those on thin planes that the lidar would have to see from behind.
    """

    distance_m: float
    aside_m: float
    one_sided: bool


@compiled
def near(pose: Array, source: Array, index: Index, points: Array, planes: Array, reach: Reach) -> Index:
    """Return which of the points ``(N, 3)`` have neighbours that count, ascending.

    Args:
        pose: ``(4, 4)`` of the scan.
        source: scan frame.
        index: ``(N,)`` of the neighbours.
        points: ``(M, 3)`` of the surface.
        planes: ``(M, 5)`` of the surface.
        reach: which neighbours count.
    """
    kept, count = np.empty(len(source), np.int64), 0
    for i in range(len(source)):
        away_m, height_m, distance2, range2, k = 0.0, 0.0, 0.0, 0.0, index[i]
        for row in range(3):
            turned = pose[row, 0] * source[i, 0] + pose[row, 1] * source[i, 1] + pose[row, 2] * source[i, 2]
            difference = turned + pose[row, 3] - points[k, row]
            distance2 += difference**2
            height_m += planes[k, row] * difference
            away_m += planes[k, row] * turned
            range2 += source[i, row] ** 2
        if distance2 >= reach.distance_m**2 or distance2 - height_m**2 >= reach.aside_m**2:
            continue
        is_behind = reach.one_sided and away_m >= _LARGEST_FROM_BEHIND * np.sqrt(range2)
        if is_behind and planes[k, 4] >= THIN_PLANE_WEIGHT:
            continue
        kept[count] = i
        count += 1
    return kept[:count].copy()


@compiled
def follow(
    pose: Array,
    source: Array,
    searched: Array,
    candidates: Candidates,
    points: Array,
    index: Index,
) -> tuple[Index, Array]:
    """Take the neighbours at a pose from their candidates; return the points ``(K,)`` that have moved too far for that.

    Args:
        pose: ``(4, 4)``.
        source: ``(N, 3)`` scan frame.
        searched: ``(N, 3)`` where each point was when its neighbour was searched; for the returned ones it is updated.
        candidates: of all points, where they were searched.
        points: ``(M, 3)`` of the surface.
        index: ``(N,)`` of the neighbours; updated for the points that are not returned.

    Returns:
        those points, and where they are now ``(K, 3)``.
    """
    which, queries, count = np.empty(len(source), np.int64), np.empty(source.shape), 0
    for i in range(len(source)):
        squared = 0.0
        for row in range(3):
            moved = pose[row, 0] * source[i, 0] + pose[row, 1] * source[i, 1] + pose[row, 2] * source[i, 2]
            queries[count, row] = moved + pose[row, 3]
            squared += (queries[count, row] - searched[i, row]) ** 2
        if squared >= candidates.reach_m[i] ** 2:
            which[count], searched[i] = i, queries[count]
            count += 1
            continue
        index[i] = candidates.nearest[i, 0]
        if squared < candidates.own_m[i] ** 2:
            continue
        least = np.inf
        for k in candidates.nearest[i]:
            distance2 = 0.0
            for row in range(3):
                distance2 += (queries[count, row] - points[k, row]) ** 2
            if distance2 < least:
                least, index[i] = distance2, k
    return which[:count].copy(), queries[:count].copy()


@compiled
def costs(
    pose: Array, source: Array, index: Index, points: Array, planes: Array, max_distance_m: float, kernel_m: float
) -> Array:
    """Return the robust cost ``(N,)`` of each point, 0 to 1, NaN where the neighbour is too far; as :func:`near`."""
    out = np.full(len(source), np.nan)
    for i in range(len(source)):
        distance, distance2, k = 0.0, 0.0, index[i]
        for row in range(3):
            turned = pose[row, 0] * source[i, 0] + pose[row, 1] * source[i, 1] + pose[row, 2] * source[i, 2]
            off = turned + pose[row, 3] - points[k, row]
            distance2 += off * off
            distance += planes[k, row] * off
        if distance2 < max_distance_m * max_distance_m:
            out[i] = distance * distance / (kernel_m * kernel_m + distance * distance)
    return out


@compiled
def lever_arms(points: Array) -> Array:
    """Return the ``(3,)`` of :func:`hybridlio.registration.information.lever_arms`."""
    x2, y2, z2 = 0.0, 0.0, 0.0
    for i in range(len(points)):
        x2 += points[i, 0] * points[i, 0]
        y2 += points[i, 1] * points[i, 1]
        z2 += points[i, 2] * points[i, 2]
    count = max(len(points), 1)
    return np.sqrt(np.maximum(np.array([y2 + z2, x2 + z2, x2 + y2]) / count, 1e-6))


@compiled
def linearise(pose: Array, source: Array, planes: Array) -> Array:
    """Return the rows ``(7, N)`` of points ``(N, 3)`` matched with planes ``(N, 5)`` at a pose ``(4, 4)``."""
    rows = np.empty((7, len(source)))
    for i in range(len(source)):
        nx, ny, nz = planes[i, 0], planes[i, 1], planes[i, 2]
        x, y, z = source[i, 0], source[i, 1], source[i, 2]
        a = nx * pose[0, 0] + ny * pose[1, 0] + nz * pose[2, 0]  # the normal in the scan's frame
        b = nx * pose[0, 1] + ny * pose[1, 1] + nz * pose[2, 1]
        c = nx * pose[0, 2] + ny * pose[1, 2] + nz * pose[2, 2]
        rows[0, i], rows[1, i], rows[2, i] = y * c - z * b, z * a - x * c, x * b - y * a
        rows[3, i], rows[4, i], rows[5, i] = a, b, c
        along = nx * pose[0, 3] + ny * pose[1, 3] + nz * pose[2, 3]
        rows[6, i] = x * a + y * b + z * c + along - planes[i, 3]
    return rows
