"""Vertex and normal maps: a scan as an image over azimuth and elevation.

Source: UnDeepLIO, "Vertex map", "Normal map" and "Mapping the point clouds of current frame to the last frame". A map
is ``(3, H, W)`` float32; an empty cell is 0 in all three channels, and the first and last columns are neighbours.

The paper gives the row as ``(f_h − arcsin(z/d))/η_h`` with ``f_h = 23°``, which would cover +23° to −3° and miss the
road. Here 23° is the lower limit: the preset's rows cover +3° to −23°, from the top.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridlio.cloud.map_geometry import MapGeometry
from hybridlio.core import se3
from hybridlio.core.arrays import Floats

_EMPTY = np.iinfo(np.uint64).max
_CHUNK = 16384  # points at a time, whose temporaries stay in the processor's cache: twice as fast as all at once
_DEG = np.float32(180.0) / np.float32(np.pi)  # multiplying by it is ten times as fast as np.degrees
_RANGE_DECAY_PER_M = np.float32(-0.5)  # of a neighbour's weight in a normal, from the paper's "Normal map"


def winner_map(points: ArrayLike, geometry: MapGeometry) -> NDArray[np.int32]:
    """Return the index of the nearest point in each cell, ``(H, W)``, −1 for empty cells.

    Args:
        points: ``(N, 3)`` metres, lidar frame. Points that are not finite, lie in the origin or outside the rows are
            ignored. Of equally near points the first in the cloud is taken.
        geometry: the cells.
    """
    points = np.asarray(points, dtype=np.float32).reshape(-1, 3)
    nearest = np.full(geometry.rows * geometry.columns, _EMPTY, np.uint64)
    for start in range(0, len(points), _CHUNK):
        cell, depth, index = _cells(points[start : start + _CHUNK], geometry)
        # positive floats sort like their bit patterns, so the smallest (depth, index) packed in an integer is the
        # nearest
        key = (depth.view(np.uint32).astype(np.uint64) << np.uint64(32)) | (index + start).astype(np.uint64)
        np.minimum.at(nearest, cell, key)
    winners = np.where(nearest == _EMPTY, -1, (nearest & np.uint64(0xFFFFFFFF)).astype(np.int64))
    return winners.astype(np.int32).reshape(geometry.rows, geometry.columns)


def _cells(points: Floats, geometry: MapGeometry) -> tuple[NDArray[np.intp], Floats, NDArray[np.intp]]:
    """Return flat cell, range and index of the points that fall on the map."""
    x, y, z = np.ascontiguousarray(points.T)
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        depth = np.sqrt(x * x + y * y + z * z)
        row = (np.float32(geometry.fov_up_deg) - _DEG * np.arcsin(z / depth)) / np.float32(geometry.row_deg)
        column = (np.float32(180.0) - _DEG * np.arctan2(y, x)) / np.float32(geometry.column_deg)
        # comparisons with NaN are false, so this also drops points that are not finite
        index = np.flatnonzero((row >= 0) & (row < geometry.rows) & (depth < np.inf))
    # azimuth −180° falls into the column of +180°
    column_index = column[index].astype(np.intp)
    column_index[column_index >= geometry.columns] -= geometry.columns
    return row[index].astype(np.intp) * geometry.columns + column_index, depth[index], index


def gather(values: ArrayLike, winners: NDArray[np.int32]) -> Floats:
    """Return values ``(N, C)`` of the points as a map ``(C, H, W)`` float32, by the indices of :func:`winner_map`."""
    columns = np.asarray(values, dtype=np.float32).T
    flat = winners.ravel()
    filled = np.flatnonzero(flat >= 0)
    out = np.zeros((len(columns), flat.size), np.float32)
    for channel, column in zip(out, columns, strict=True):
        channel[filled] = column[flat[filled]]
    return out.reshape(-1, *winners.shape)


def vertex_map(points: ArrayLike, geometry: MapGeometry) -> Floats:
    """Return the vertex map ``(3, H, W)`` of points ``(N, 3)``, metres: each cell's nearest point, 0 if empty.

    The column is ``(180° − atan2(y, x))/η_w``, the row ``(fov_up − arcsin(z/d))/η_h``, both rounded down. For maps of
    other values of the points, use :func:`winner_map` and :func:`gather`.
    """
    points = np.asarray(points, dtype=np.float32).reshape(-1, 3)
    return gather(points, winner_map(points, geometry))


def valid_cells(any_map: NDArray[Any]) -> NDArray[np.bool_]:
    """Return which cells ``(..., H, W)`` of maps ``(..., C, H, W)`` are not empty."""
    return np.asarray((any_map != 0).any(axis=-3))


def normal_map(vertices: Floats) -> Floats:
    """Return the normal map ``(3, H, W)`` of a vertex map: unit normals, 0 where one of four neighbours is missing.

    ``n_p = Σ w_i (v_i − v_p) × w_{i+1} (v_{i+1} − v_p)`` over up, right, down, left, cyclic, with
    ``w_i = exp(−0.5 |d(v_i) − d(v_p)|)`` and d the range. Left and right neighbours wrap around; the first and last
    rows have no normals. In this order the sum points away from the sensor; its sign is changed so that normals point
    towards it, like those of :mod:`hybridlio.cloud.normals`.
    """
    depth = np.sqrt((vertices * vertices).sum(axis=0))
    arms = []
    valid = depth > 0
    for down, right in ((1, 0), (0, -1), (-1, 0), (0, 1)):  # the neighbour above moves down into the cell, and so on
        neighbour, neighbour_depth = _shifted(vertices, down, right), _shifted(depth, down, right)
        valid &= neighbour_depth > 0
        arms.append(np.exp(_RANGE_DECAY_PER_M * np.abs(neighbour_depth - depth)) * (neighbour - vertices))
    up, right_, down_, left = arms
    # the four cyclic products in one: u×r + r×d + d×l + l×u = (u − d) × (r − l)
    (ax, ay, az), (bx, by, bz) = up - down_, right_ - left
    total = np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])
    length = np.sqrt((total * total).sum(axis=0))
    valid &= length > 0
    sign = np.where((total * vertices).sum(axis=0) > 0, np.float32(-1.0), np.float32(1.0))
    return np.asarray(np.where(valid, total * (sign / np.where(valid, length, np.float32(1.0))), np.float32(0.0)))


def _shifted(values: Floats, down: int, right: int) -> Floats:
    """Return values ``(..., H, W)`` moved by rows and columns; columns wrap around, vacated rows are 0."""
    moved = np.roll(values, (down, right), axis=(-2, -1))
    if down:
        moved[..., 0 if down > 0 else -1, :] = 0.0
    return moved


def remap(vertices: Floats, normals: Floats, T_a_b: ArrayLike, geometry: MapGeometry) -> tuple[Floats, Floats]:
    """Return both maps of frame b as seen from frame a: vertices transformed and projected again, normals rotated.

    A cell takes the nearest of its vertices and is empty if it has none.

    Args:
        vertices, normals: ``(3, H, W)`` in frame b.
        T_a_b: ``(4, 4)``, such as the initial pose ``T_k_k1``.
        geometry: the cells of the result.
    """
    occupied = valid_cells(vertices)
    T = np.asarray(T_a_b, dtype=np.float64)
    moved = se3.transform(T, vertices[:, occupied].T).astype(np.float32)
    winners = winner_map(moved, geometry)
    rotated = normals[:, occupied].T @ T[:3, :3].T.astype(np.float32)
    return gather(moved, winners), gather(rotated, winners)
