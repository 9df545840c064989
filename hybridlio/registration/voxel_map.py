"""Points with planes in cubic cells of limited capacity, dropped when no scan has hit their cell for long.

A scan of a place that has been seen before mostly hits full cells, and only about one point in ten is added. Planes are
fitted to added points only: fitting them to all would be the most expensive part of a keyframe.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybridlio.cloud.kd_tree import build_tree, threads_for
from hybridlio.cloud.plane_fitting import MIN_NEIGHBOURS, FittedPlanes, Planes, fit_planes, span_several_rings
from hybridlio.cloud.voxel import voxel_labels
from hybridlio.core import se3
from hybridlio.core.arrays import Array, Index
from hybridlio.registration.ring_planes import RingPlanes
from hybridlio.registration.settings import LocalMapSettings
from hybridlio.registration.surface import Surface

Keys = NDArray[np.int64]

_KEY_BITS = 21  # per axis, so that three fit into 63 bits of an int64: ±2000 km with cells of 2 m
_KEY_ORIGIN = 1 << (_KEY_BITS - 1)

MAX_POINTS_PER_CELL = 10  # of a cell of 2 m: enough for a plane on each of two surfaces, few enough for quick searches
# A sensor is sparse if more than this share of its points within this range, in sides of a cell (20 m of cells of 2 m),
# have neighbours of a single ring. Of 64 beams none has, of 16 beams one in six.
_SPARSE_RANGE = 10.0
_SPARSE_SHARE = 0.05


class VoxelMap:
    """Points with planes, map frame; starts empty.

    Args:
        settings: side of the cells, spacing and number of neighbours, horizon, threads.
    """

    def __init__(self, settings: LocalMapSettings) -> None:
        self._settings = settings
        self._cells, self._ring_planes = CellTable(), RingPlanes(settings.voxel_m)
        self._parts: list[Planes] = []  # of every insertion since cells were last dropped
        self._insertions = 0

    def rescale(self, settings: LocalMapSettings) -> None:
        """Go on with cells of another side; all points stay, and count as hit by the last insertion."""
        self._settings = settings
        self._cells, self._ring_planes = CellTable(), RingPlanes(settings.voxel_m)
        if self._parts:
            labels, cells = cells_of(np.concatenate([part.points for part in self._parts]), settings.voxel_m)
            self._cells.record_hits(cells, np.bincount(labels, minlength=len(cells)), self._insertions - 1)

    def insert(self, points: Array, T_map_lidar: Array, surface: Surface | None) -> Planes:
        """Add those of a scan's points for which there is room.

        Points nearer to the surface's than the spacing and points whose neighbours make no plane are left out. For a
        sparse sensor, points whose neighbours belong to one ring get a plane from the last keyframes' points.

        Args:
            points: ``(N, 3)`` lidar frame.
            T_map_lidar: ``(4, 4)``.
            surface: of the points added so far; None if there are none.

        Returns:
            the points that were added, with their planes, whose normals point to the lidar.
        """
        spacing_m, threads = self._settings.spacing_m, self._settings.threads
        moved = se3.transform(T_map_lidar, points)
        labels, cells = cells_of(moved, self._settings.voxel_m)
        chosen = _fit_capacity(MAX_POINTS_PER_CELL - self._cells.counts(cells), labels)
        if surface is not None and len(chosen):
            chosen = chosen[surface.nearest(moved[chosen], threads)[1] >= spacing_m**2]
        in_scan, planes, on_one_ring = _split_by_plane(points, chosen, self._settings.neighbours, threads)
        if not _is_sparse(points[chosen], points[on_one_ring], _SPARSE_RANGE * self._settings.voxel_m):
            on_one_ring = on_one_ring[
                :0
            ]  # distant rings of a dense sensor are not needed, and such planes are less exact
        across_scans, ring_planes = self._ring_planes.add_keyframe(moved[on_one_ring], threads)
        added = np.concatenate([in_scan, on_one_ring[across_scans]])
        self._cells.record_hits(cells, np.bincount(labels[added], minlength=len(cells)), self._insertions)
        self._insertions += 1
        normals = np.concatenate([planes.normals @ T_map_lidar[:3, :3].T, ring_planes.normals])
        away = np.einsum("ij,ij->i", normals, moved[added] - T_map_lidar[:3, 3]) > 0
        normals[away] *= -1
        new = Planes(moved[added], normals, np.concatenate([planes.weights, ring_planes.weights]))
        self._parts.append(new)
        return new

    def drop_expired(self) -> Planes:
        """Drop the cells that the last insertions have not hit, and return all remaining points."""
        everything = Planes(*(np.concatenate(column) for column in zip(*self._parts, strict=True)))
        self._cells.drop_before(self._insertions - self._settings.horizon_keyframes)
        labels, cells = cells_of(everything.points, self._settings.voxel_m)
        kept = self._cells.contains(cells)
        if not kept.all():
            everything = Planes(*(column[kept[labels]] for column in everything))
        self._parts = [everything]
        return everything


def _is_sparse(points: Array, on_one_ring: Array, range_m: float) -> bool:
    """Return whether many of the points near the lidar have neighbours of one ring only."""
    near, near_on_one_ring = (np.einsum("ij,ij->i", p, p) < range_m**2 for p in (points, on_one_ring))
    return bool(near_on_one_ring.sum() > _SPARSE_SHARE * near.sum())


def _fit_capacity(room: NDArray[np.int64], labels: Index) -> Index:
    """Return the points that fit into their cells, which have ``room`` ``(C,)`` and hold points ``labels`` ``(N,)``."""
    candidates = np.flatnonzero(room[labels] > 0)
    order = candidates[np.argsort(labels[candidates], kind="stable")]
    ordered = labels[order]
    rank = np.arange(len(ordered)) - np.searchsorted(ordered, ordered)  # among those of the same cell
    return np.sort(order[rank < room[ordered]])


def _split_by_plane(points: Array, chosen: Index, neighbours: int, threads: int) -> tuple[Index, FittedPlanes, Index]:
    """Return those of ``chosen`` with neighbours of several rings, their planes, and those of one ring."""
    neighbours = min(neighbours, len(points))
    if neighbours < MIN_NEIGHBOURS or not len(chosen):
        return chosen[:0], fit_planes(np.empty((0, MIN_NEIGHBOURS, 3))), chosen[:0]
    useful = threads_for(2 * len(chosen), threads)  # ten neighbours take twice as long as one or two
    index, _ = build_tree(points, threads).batch_knn_search(points[chosen], neighbours, useful)
    several = span_several_rings(points, index)
    return chosen[several], fit_planes(points.take(index[several], axis=0)), chosen[~several]


def cells_of(points: Array, side_m: float) -> tuple[Index, Keys]:
    """Return the cell of each of the points ``(N, 3)``: labels ``(N,)`` from 0, and the keys ``(C,)`` of the cells.

    Keys ascend, and a cell has the same key whatever other points there are.
    """
    single = points.astype(np.float32)
    labels, count = voxel_labels(single, side_m)
    member = np.empty(count, np.intp)
    member[labels] = np.arange(len(labels))  # any point of each cell
    x, y, z = np.floor(single[member] / np.float32(side_m)).astype(np.int64).T + _KEY_ORIGIN
    return labels, ((z << _KEY_BITS | y) << _KEY_BITS) | x


class CellTable:
    """Number of points in each cell, and when a scan last hit it, as arrays sorted by key; starts empty."""

    def __init__(self) -> None:
        self._keys: Keys = np.empty(0, np.int64)  # ascending
        self._counts = np.empty(0, np.int64)
        self._last_hits = np.empty(0, np.int64)

    def counts(self, keys: Keys) -> NDArray[np.int64]:
        """Return the number of points ``(C,)`` in each of the cells."""
        at, known = self._find(keys)
        counts = np.zeros(len(keys), np.int64)
        counts[known] = self._counts[at[known]]
        return counts

    def record_hits(self, keys: Keys, added: NDArray[np.int64], time: int) -> None:
        """Record that a scan hit these cells at a time, and the number of points ``(C,)`` added to each."""
        at, known = self._find(keys)
        self._counts[at[known]] += added[known]
        self._last_hits[at[known]] = time
        new = ~known & (added > 0)
        self._keys = np.insert(self._keys, at[new], keys[new])
        self._counts = np.insert(self._counts, at[new], added[new])
        self._last_hits = np.insert(self._last_hits, at[new], time)

    def drop_before(self, time: int) -> None:
        """Drop the cells that were last hit before a time."""
        kept = self._last_hits >= time
        self._keys, self._counts, self._last_hits = self._keys[kept], self._counts[kept], self._last_hits[kept]

    def contains(self, keys: Keys) -> NDArray[np.bool_]:
        """Return which of the cells ``(C,)`` are in the table."""
        return self._find(keys)[1]

    def _find(self, keys: Keys) -> tuple[Index, NDArray[np.bool_]]:
        """Return where each key is or would be inserted, and whether it is there."""
        at = np.searchsorted(self._keys, keys)
        known = np.zeros(len(keys), bool)
        inside = at < len(self._keys)
        known[inside] = self._keys[at[inside]] == keys[inside]
        return at, known
