"""The local map's points in cubic cells that take in a few each, and are forgotten when no scan has hit them for long.

A scan of a place that was seen before mostly hits cells that are full. Planes are fitted only to its points that a cell
takes in, one in ten: fitting them to all would take longer than anything else that a keyframe needs.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridlio import se3
from hybridlio.cell_table import CellTable, cells_of
from hybridlio.estimates import Array
from hybridlio.point_tree import build_tree, threads_for
from hybridlio.surface import Surface

Index = NDArray[np.intp]

MOST = 10  # points a cell
_APART_M = 0.1
_THIN_M = 0.15  # so thick a plane counts half
_LEAST = 5  # neighbours that make a plane
_RING_RAD = np.deg2rad(0.1)  # beams of spinning lidars are 0.3° apart and more
_LEAST_OF_OTHERS = 2  # of ten


class Planes(NamedTuple):
    """Points with the planes about them, map frame.

    Attributes:
        points, normals: ``(M, 3)`` each.
        weights: ``(M,)``, how much each plane counts.
    """

    points: Array
    normals: Array
    weights: Array


class MapCells:
    """Points with normals, map frame; starts empty.

    Args:
        side_m: of the cells.
        horizon: a cell that so many insertions have not hit is forgotten.
        neighbours: points of a scan to fit a plane to for a normal.
        threads: for trees.
    """

    def __init__(self, side_m: float, horizon: int, neighbours: int, threads: int) -> None:
        self._side_m, self._horizon, self._neighbours, self._threads = side_m, horizon, neighbours, threads
        self._table = CellTable()
        self._parts: list[Planes] = []  # of every insertion since what was forgotten was dropped
        self._insertions = 0

    def insert(self, points: Array, T_map_lidar: Array, known: Surface | None) -> Planes:
        """Take in what there is room for of a scan's points ``(N, 3)``, lidar frame; ``known`` is of the points so far.

        Points that lie beside one of ``known``, or that have no neighbours to make a plane, are left out.

        Returns:
            those taken in.
        """
        moved = se3.transform(T_map_lidar, points)
        labels, cells = cells_of(moved, self._side_m)
        taken = _with_room(MOST - self._table.held(cells), labels)
        if known is not None and len(taken):
            taken = taken[known.nearest(moved[taken], self._threads)[1] >= _APART_M**2]
        taken, normals, weights = _with_planes(points, taken, self._neighbours, self._threads)
        self._table.hit(cells, np.bincount(labels[taken], minlength=len(cells)), self._insertions)
        self._insertions += 1
        new = Planes(moved[taken], normals @ T_map_lidar[:3, :3].T, weights)
        self._parts.append(new)
        return new

    def remembered(self) -> Planes:
        """All but those of cells that are forgotten, which are dropped."""
        everything = Planes(*(np.concatenate(column) for column in zip(*self._parts, strict=True)))
        self._table.forget(self._insertions - self._horizon)
        labels, cells = cells_of(everything.points, self._side_m)
        kept = self._table.has(cells)
        if not kept.all():
            everything = Planes(*(column[kept[labels]] for column in everything))
        self._parts = [everything]
        return everything


def _with_room(room: NDArray[np.int64], cells: Index) -> Index:
    """Which points find room, where ``cells`` ``(N,)`` they lie in have ``room`` for so many each."""
    candidates = np.flatnonzero(room[cells] > 0)
    order = candidates[np.argsort(cells[candidates], kind="stable")]
    ordered = cells[order]
    rank = np.arange(len(ordered)) - np.searchsorted(ordered, ordered)  # among those of the same cell
    return np.sort(order[rank < room[ordered]])


def _with_planes(points: Array, wanted: Index, neighbours: int, threads: int) -> tuple[Index, Array, Array]:
    """Those of ``wanted`` whose nearest points make a plane, its normals ``(M, 3)``, of least spread, and weights.

    A hedge's points make no plane, and pull a scan anywhere: what a scan's points lie off planes was seen to grow with
    their thickness, the root mean square along the normal. On simulated drives weights by the inverse square of that
    are the best (half at 3 cm); with real scans and poses so narrow a choice makes paths longer than they are.
    """
    neighbours = min(neighbours, len(points))
    if neighbours < _LEAST or not len(wanted):
        return wanted[:0], np.empty((0, 3)), np.empty(0)
    worth = threads_for(2 * len(wanted), threads)  # ten neighbours take twice as long as one or two
    index, _ = build_tree(points, threads).batch_knn_search(points[wanted], neighbours, worth)
    several = _of_several_rings(points, index)
    near = points.take(index[several], axis=0)
    near -= near.mean(axis=1, keepdims=True)
    spread, axes = np.linalg.eigh(near.transpose(0, 2, 1) @ near)
    thick2 = np.maximum(spread[:, 0], 0.0) / neighbours
    return wanted[several], np.asarray(axes[:, :, 0]), np.asarray(_THIN_M**2 / (_THIN_M**2 + thick2))


def _of_several_rings(points: Array, near: NDArray[np.uint64]) -> NDArray[np.bool_]:
    """Whether those of the points ``(N, 3)``, lidar frame, that ``near`` ``(M, K)`` numbers are of more than one beam.

    One beam's points lie on a cone about the lidar's axis: whatever it hits, their plane is the cone's. On a far wall
    its normal stands upright, and the next scan's ring would be pulled to the height of this one's.
    """
    elevation_rad = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    beams_rad = np.sort(elevation_rad[near], axis=1)
    count = beams_rad.shape[1]
    middle_rad = (beams_rad[:, (count - 1) // 2] + beams_rad[:, count // 2]) / 2  # np.median takes three times as long
    others = np.abs(beams_rad - middle_rad[:, None]) > _RING_RAD
    return np.asarray(others.sum(axis=1) >= _LEAST_OF_OTHERS)
