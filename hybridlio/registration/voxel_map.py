"""The local map's points in cubic cells that take in a few each, and are forgotten when no scan has hit them for long.

A scan of a place that was seen before mostly hits cells that are full. Planes are fitted only to its points that a cell
takes in, one in ten: fitting them to all would take longer than anything else that a keyframe needs.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybridlio.cloud.kd_tree import build_tree, threads_for
from hybridlio.cloud.plane_fitting import LEAST_NEIGHBOURS, Fitted, Planes, fit_planes, of_several_rings
from hybridlio.cloud.voxel import voxel_labels
from hybridlio.core import se3
from hybridlio.core.arrays import Array, Index
from hybridlio.registration.ring_planes import LoosePoints
from hybridlio.registration.surface import Surface

Keys = NDArray[np.int64]

_BITS = 21  # of a cell's place along an axis
_MIDDLE = 1 << (_BITS - 1)
MOST = 10  # points a cell
_APART_M = 0.1
_SPARSE_RANGE_M = 20.0  # within it 64 beams leave no point without another beam's beside it; 16 beams one in six
_SPARSE = 0.05


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
        self._table, self._loose = CellTable(), LoosePoints()
        self._parts: list[Planes] = []  # of every insertion since what was forgotten was dropped
        self._insertions = 0

    def insert(self, points: Array, T_map_lidar: Array, known: Surface | None) -> Planes:
        """Take in what there is room for of a scan's points ``(N, 3)``, lidar frame; ``known`` is of the points so far.

        Points that lie beside one of ``known``, or that have no neighbours to make a plane, are left out. Where the
        neighbours of a sparse scan's are of one beam, the last keyframes' are asked.

        Returns:
            those taken in.
        """
        moved = se3.transform(T_map_lidar, points)
        labels, cells = cells_of(moved, self._side_m)
        taken = _with_room(MOST - self._table.held(cells), labels)
        if known is not None and len(taken):
            taken = taken[known.nearest(moved[taken], self._threads)[1] >= _APART_M**2]
        own, planes, alone = _with_planes(points, taken, self._neighbours, self._threads)
        if not _are_sparse(points[taken], points[alone]):
            alone = alone[:0]  # what is farther away needs no help, and planes of several scans are less sure
        helped, others = self._loose.take_in(moved[alone], self._threads)
        taken = np.concatenate([own, alone[helped]])
        self._table.hit(cells, np.bincount(labels[taken], minlength=len(cells)), self._insertions)
        self._insertions += 1
        normals = np.concatenate([planes.normals @ T_map_lidar[:3, :3].T, others.normals])
        new = Planes(moved[taken], normals, np.concatenate([planes.weights, others.weights]))
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


def _are_sparse(points: Array, alone: Array) -> bool:
    """Whether of the points near the lidar too many are ``alone``, with none of another beam beside them."""
    near, near_alone = (np.einsum("ij,ij->i", p, p) < _SPARSE_RANGE_M**2 for p in (points, alone))
    return bool(near_alone.sum() > _SPARSE * near.sum())


def _with_room(room: NDArray[np.int64], cells: Index) -> Index:
    """Which points find room, where ``cells`` ``(N,)`` they lie in have ``room`` for so many each."""
    candidates = np.flatnonzero(room[cells] > 0)
    order = candidates[np.argsort(cells[candidates], kind="stable")]
    ordered = cells[order]
    rank = np.arange(len(ordered)) - np.searchsorted(ordered, ordered)  # among those of the same cell
    return np.sort(order[rank < room[ordered]])


def _with_planes(points: Array, wanted: Index, neighbours: int, threads: int) -> tuple[Index, Fitted, Index]:
    """Those of ``wanted`` whose nearest points make a plane, the planes, and those whose nearest are of one beam."""
    neighbours = min(neighbours, len(points))
    if neighbours < LEAST_NEIGHBOURS or not len(wanted):
        return wanted[:0], fit_planes(np.empty((0, LEAST_NEIGHBOURS, 3))), wanted[:0]
    worth = threads_for(2 * len(wanted), threads)  # ten neighbours take twice as long as one or two
    index, _ = build_tree(points, threads).batch_knn_search(points[wanted], neighbours, worth)
    several = of_several_rings(points, index)
    return wanted[several], fit_planes(points.take(index[several], axis=0)), wanted[~several]


def cells_of(points: Array, side_m: float) -> tuple[Index, Keys]:
    """Which cell each of the points ``(N, 3)`` is in: numbers ``(N,)`` from 0, and the keys ``(C,)`` of those cells.

    Keys ascend, and a cell has the same one whatever the points.
    """
    single = points.astype(np.float32)
    labels, count = voxel_labels(single, side_m)
    one = np.empty(count, np.intp)
    one[labels] = np.arange(len(labels))  # some point of each cell
    x, y, z = np.floor(single[one] / np.float32(side_m)).astype(np.int64).T + _MIDDLE
    return labels, ((z << _BITS | y) << _BITS) | x


class CellTable:
    """Starts empty. A cell is in it as long as it may hold points."""

    def __init__(self) -> None:
        self._keys: Keys = np.empty(0, np.int64)  # ascending
        self._held = np.empty(0, np.int64)
        self._hit = np.empty(0, np.int64)

    def held(self, keys: Keys) -> NDArray[np.int64]:
        """How many points ``(C,)`` each of the cells holds."""
        at, known = self._find(keys)
        held = np.zeros(len(keys), np.int64)
        held[known] = self._held[at[known]]
        return held

    def hit(self, keys: Keys, added: NDArray[np.int64], time: int) -> None:
        """Note that a scan hit these cells at a time, and how many points ``(C,)`` they took in."""
        at, known = self._find(keys)
        self._held[at[known]] += added[known]
        self._hit[at[known]] = time
        new = ~known & (added > 0)
        self._keys = np.insert(self._keys, at[new], keys[new])
        self._held = np.insert(self._held, at[new], added[new])
        self._hit = np.insert(self._hit, at[new], time)

    def forget(self, before: int) -> None:
        """Drop the cells that were last hit before a time."""
        kept = self._hit >= before
        self._keys, self._held, self._hit = self._keys[kept], self._held[kept], self._hit[kept]

    def has(self, keys: Keys) -> NDArray[np.bool_]:
        """Which of the cells ``(C,)`` are in the table."""
        return self._find(keys)[1]

    def _find(self, keys: Keys) -> tuple[Index, NDArray[np.bool_]]:
        """Where each key is or would be, and whether it is there."""
        at = np.searchsorted(self._keys, keys)
        known = np.zeros(len(keys), bool)
        inside = at < len(self._keys)
        known[inside] = self._keys[at[inside]] == keys[inside]
        return at, known
