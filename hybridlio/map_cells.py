"""The local map's points in cubic cells that take in a few each, and are forgotten when no scan has hit them for long.

A scan of a place that was seen before mostly hits cells that are full. Planes are fitted only to its points that a cell
takes in, one in ten: fitting them to all would take longer than anything else that a keyframe needs.
"""

from __future__ import annotations

import numpy as np
import small_gicp
from numpy.typing import NDArray

from hybridlio import se3
from hybridlio.estimates import Array
from hybridlio.surface import Surface
from hybridlio.voxel import voxel_labels

Index = NDArray[np.intp]

MOST = 10  # points a cell
_APART_M = 0.1
_LEAST = 5  # neighbours that make a plane
_RING_RAD = np.deg2rad(0.1)  # beams of spinning lidars are 0.3° apart and more
_LEAST_OF_OTHERS = 2  # of ten


class MapCells:
    """Points with normals, map frame; starts empty.

    Args:
        side_m: of the cells.
        horizon: a cell that so many insertions have not hit is forgotten.
        neighbours: points of a scan to fit a plane to for a normal.
        threads: for trees.

    Attributes:
        points, normals: ``(M, 3)`` each.
    """

    def __init__(self, side_m: float, horizon: int, neighbours: int, threads: int) -> None:
        self._side_m, self._horizon, self._neighbours, self._threads = side_m, horizon, neighbours, threads
        self.points: Array = np.empty((0, 3))
        self.normals: Array = np.empty((0, 3))
        self._hit = np.empty(0, np.int64)  # of each point, the last insertion that hit its cell
        self._insertions = 0

    def insert(self, points: Array, T_map_lidar: Array, known: Surface | None) -> None:
        """Take in what there is room for of a scan's points ``(N, 3)``, lidar frame; ``known`` is of the points so far.

        Points that lie beside one of ``known``, or that have no neighbours to make a plane, are left out.
        """
        moved = se3.transform(T_map_lidar, points)
        labels, count = voxel_labels(np.concatenate([self.points, moved]).astype(np.float32), self._side_m)
        old, new = labels[: len(self.points)], labels[len(self.points) :]
        taken = _with_room(old, new, count)
        if known is not None and len(taken):
            taken = taken[known.nearest(moved[taken], self._threads)[1] >= _APART_M**2]
        taken, normals = _with_planes(points, taken, self._neighbours, self._threads)
        normals = normals @ T_map_lidar[:3, :3].T
        self._hit[(np.bincount(new, minlength=count) > 0)[old]] = self._insertions
        kept = self._hit > self._insertions - self._horizon
        self.points = np.concatenate([self.points[kept], moved[taken]])
        self.normals = np.concatenate([self.normals[kept], normals])
        self._hit = np.concatenate([self._hit[kept], np.full(len(taken), self._insertions)])
        self._insertions += 1


def _with_room(old: Index, new: Index, count: int) -> Index:
    """Which of the new points find room in their cells, of ``count``, where the old ones are."""
    free = MOST - np.bincount(old, minlength=count)
    candidates = np.flatnonzero(free[new] > 0)
    order = candidates[np.argsort(new[candidates], kind="stable")]
    cells = new[order]
    rank = np.arange(len(cells)) - np.searchsorted(cells, cells)  # among those of the same cell
    return np.sort(order[rank < free[cells]])


def _with_planes(points: Array, wanted: Index, neighbours: int, threads: int) -> tuple[Index, Array]:
    """Those of ``wanted`` whose nearest points make a plane, and its normals ``(M, 3)``, of least spread."""
    neighbours = min(neighbours, len(points))
    if neighbours < _LEAST or not len(wanted):
        return wanted[:0], np.empty((0, 3))
    index, _ = small_gicp.KdTree(points, threads).batch_knn_search(points[wanted], neighbours, threads)
    near = points[index]
    several = _of_several_rings(near)
    near = near[several]
    near -= near.mean(axis=1, keepdims=True)
    return wanted[several], np.asarray(np.linalg.eigh(near.transpose(0, 2, 1) @ near)[1][:, :, 0])


def _of_several_rings(near: Array) -> NDArray[np.bool_]:
    """Whether points ``(M, K, 3)``, lidar frame, are of more than one beam.

    One beam's points lie on a cone about the lidar's axis: whatever it hits, their plane is the cone's. On a far wall
    its normal stands upright, and the next scan's ring would be pulled to the height of this one's.
    """
    elevation_rad = np.arcsin(near[..., 2] / np.maximum(np.linalg.norm(near, axis=-1), 1e-9))
    others = np.abs(elevation_rad - np.median(elevation_rad, axis=1, keepdims=True)) > _RING_RAD
    return np.asarray(others.sum(axis=1) >= _LEAST_OF_OTHERS)
