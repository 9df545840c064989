"""Vertex and normal maps: a scan as an image over azimuth and elevation.

Source: UnDeepLIO, "Vertex map", "Normal map" and "Mapping the point clouds of current frame to the last frame". A map
is ``(3, H, W)`` float32, an empty cell is 0 in all three channels, and the first and last column are neighbours.

The paper prints the row as ``(f_h − arcsin(z/d))/η_h`` with ``f_h = 23°``; read literally this covers +23° to −3° and
misses the road. 23° is the lower limit, so the rows of its preset cover +3° to −23°, from the top.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridlio.core import se3
from hybridlio.core.arrays import Floats
from hybridlio.core.errors import ConfigError
from hybridlio.core.sensors import LIDAR_MODELS, LidarModel

_EMPTY = np.iinfo(np.uint64).max
_PIECE = 16384
_DEG = np.float32(180.0) / np.float32(np.pi)  # np.degrees, which does the same, takes ten times as long as a product


@dataclass(frozen=True)
class MapGeometry:
    """How a sphere of directions is cut into cells.

    Attributes:
        fov_up_deg: elevation of the upper edge of row 0.
        fov_down_deg: elevation of the lower edge of the last row.
        rows, columns: H and W; columns span the whole turn, from azimuth +180° (behind, over the left) downwards.
    """

    fov_up_deg: float
    fov_down_deg: float
    rows: int
    columns: int

    def __post_init__(self) -> None:
        if not -90.0 <= self.fov_down_deg < self.fov_up_deg <= 90.0:
            raise ConfigError(
                f"map geometry: need -90 <= fov_down_deg < fov_up_deg <= 90, got {self.fov_down_deg}, {self.fov_up_deg}"
            )
        if self.rows < 1 or self.columns < 1:
            raise ConfigError(f"map geometry: needs rows and columns, got {self.rows} x {self.columns}")

    @property
    def row_deg(self) -> float:
        """η_h, the height of a cell in degrees."""
        return (self.fov_up_deg - self.fov_down_deg) / self.rows

    @property
    def column_deg(self) -> float:
        """η_w, the width of a cell in degrees."""
        return 360.0 / self.columns

    @classmethod
    def by_beam(cls, lidar: LidarModel, columns: int = 720) -> MapGeometry:
        """One row a beam, beams in the middle of their rows, for a sensor whose beams are evenly spread."""
        top, bottom = max(lidar.elevations_deg), min(lidar.elevations_deg)
        half = (top - bottom) / (lidar.beams - 1) / 2 if lidar.beams > 1 else 0.5
        return cls(top + half, bottom - half, lidar.beams, columns)


MAP_GEOMETRIES: dict[str, MapGeometry] = {
    "hdl-64e": MapGeometry(3.0, -23.0, 52, 720),  # the paper's: 0.5° both ways
    "32-beam": MapGeometry.by_beam(LIDAR_MODELS["32-beam"]),
    "16-beam": MapGeometry.by_beam(LIDAR_MODELS["16-beam"]),
}


def map_geometry(lidar: str) -> MapGeometry:
    """The preset of a lidar by name.

    Raises:
        ConfigError: there is no preset of that name.
    """
    if lidar not in MAP_GEOMETRIES:
        raise ConfigError(f"no map geometry named {lidar!r}; there are {', '.join(MAP_GEOMETRIES)}, or give its limits")
    return MAP_GEOMETRIES[lidar]


def winner_map(points: ArrayLike, geometry: MapGeometry) -> NDArray[np.int32]:
    """Which point each cell shows: the index of the nearest, ``(H, W)``, −1 where a cell is empty.

    Args:
        points: ``(N, 3)`` metres, lidar frame. Points that are not finite, lie in the origin or outside the rows are
            left out. Of points equally near, the first in the cloud wins.
        geometry: the cells.
    """
    points = np.asarray(points, dtype=np.float32).reshape(-1, 3)
    nearest = np.full(geometry.rows * geometry.columns, _EMPTY, np.uint64)
    # in pieces whose temporaries stay in the processor's cache: twice as fast as all at once
    for start in range(0, len(points), _PIECE):
        cell, depth, index = _cells(points[start : start + _PIECE], geometry)
        # positive floats order like their bits: the least of (depth, index) in one integer is the nearest point
        key = (depth.view(np.uint32).astype(np.uint64) << np.uint64(32)) | (index + start).astype(np.uint64)
        np.minimum.at(nearest, cell, key)
    winners = np.where(nearest == _EMPTY, -1, (nearest & np.uint64(0xFFFFFFFF)).astype(np.int64))
    return winners.astype(np.int32).reshape(geometry.rows, geometry.columns)


def _cells(points: Floats, geometry: MapGeometry) -> tuple[NDArray[np.intp], Floats, NDArray[np.intp]]:
    """Flat cell, range and index of those points that fall on the map."""
    x, y, z = np.ascontiguousarray(points.T)
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        depth = np.sqrt(x * x + y * y + z * z)
        row = (np.float32(geometry.fov_up_deg) - _DEG * np.arcsin(z / depth)) / np.float32(geometry.row_deg)
        column = (np.float32(180.0) - _DEG * np.arctan2(y, x)) / np.float32(geometry.column_deg)
        # NaN compares false: one test sorts out what is not finite too
        index = np.flatnonzero((row >= 0) & (row < geometry.rows) & (depth < np.inf))
    # straight behind, azimuth −180° is +180° again
    column_index = column[index].astype(np.intp)
    column_index[column_index >= geometry.columns] -= geometry.columns
    return row[index].astype(np.intp) * geometry.columns + column_index, depth[index], index


def gather(values: ArrayLike, winners: NDArray[np.int32]) -> Floats:
    """Values ``(N, C)`` of the points, as a map ``(C, H, W)`` float32 by :func:`winner_map`; 0 in empty cells."""
    columns = np.asarray(values, dtype=np.float32).T
    flat = winners.ravel()
    filled = np.flatnonzero(flat >= 0)
    out = np.zeros((len(columns), flat.size), np.float32)
    for channel, column in zip(out, columns, strict=True):
        channel[filled] = column[flat[filled]]
    return out.reshape(-1, *winners.shape)


def vertex_map(points: ArrayLike, geometry: MapGeometry) -> Floats:
    """Vertex map ``(3, H, W)`` of points ``(N, 3)``, metres: each cell's nearest point, 0 where there is none.

    Column ``(180° − atan2(y, x))/η_w``, row ``(fov_up − arcsin(z/d))/η_h``, both rounded down. To carry other values of
    the points along, use :func:`winner_map` and :func:`gather`.
    """
    points = np.asarray(points, dtype=np.float32).reshape(-1, 3)
    return gather(points, winner_map(points, geometry))


def valid_cells(any_map: NDArray[Any]) -> NDArray[np.bool_]:
    """Cells ``(..., H, W)`` of maps ``(..., C, H, W)`` that hold something."""
    return np.asarray((any_map != 0).any(axis=-3))


def normal_map(vertices: Floats) -> Floats:
    """Normal map ``(3, H, W)`` of a vertex map: unit normals from the four neighbours, 0 where one of them is missing.

    ``n_p = Σ w_i (v_i − v_p) × w_{i+1} (v_{i+1} − v_p)`` over up, right, down, left, cyclic, with
    ``w_i = exp(−0.5 |d(v_i) − d(v_p)|)`` and d the range. The left and right neighbours wrap around; the first and last
    row have none above or below, hence no normal. In this order the sum points away from the sensor; the sign is chosen
    so that normals point towards it, like those of :mod:`hybridlio.cloud.normals`.
    """
    depth = np.sqrt((vertices * vertices).sum(axis=0))
    arms = []
    valid = depth > 0
    for down, right in ((1, 0), (0, -1), (-1, 0), (0, 1)):  # the neighbour above moves down into the cell, and so on
        neighbour, its_depth = _shifted(vertices, down, right), _shifted(depth, down, right)
        valid &= its_depth > 0
        arms.append(np.exp(np.float32(-0.5) * np.abs(its_depth - depth)) * (neighbour - vertices))
    up, right_, down_, left = arms
    # the four cyclic products in one: u×r + r×d + d×l + l×u = (u − d) × (r − l)
    (ax, ay, az), (bx, by, bz) = up - down_, right_ - left
    total = np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])
    length = np.sqrt((total * total).sum(axis=0))
    valid &= length > 0
    sign = np.where((total * vertices).sum(axis=0) > 0, np.float32(-1.0), np.float32(1.0))
    return np.asarray(np.where(valid, total * (sign / np.where(valid, length, np.float32(1.0))), np.float32(0.0)))


def _shifted(values: Floats, down: int, right: int) -> Floats:
    """Values ``(..., H, W)`` moved by rows and columns; columns wrap around, rows that nothing moves into are 0."""
    moved = np.roll(values, (down, right), axis=(-2, -1))
    if down:
        moved[..., 0 if down > 0 else -1, :] = 0.0
    return moved


def remap(vertices: Floats, normals: Floats, T_a_b: ArrayLike, geometry: MapGeometry) -> tuple[Floats, Floats]:
    """Both maps of frame b as seen from frame a: vertices moved and projected again, normals rotated with them.

    Cells onto which several vertices fall show the nearest, cells onto which none falls are empty.

    Args:
        vertices, normals: ``(3, H, W)`` in frame b.
        T_a_b: ``(4, 4)``, such as the initial pose ``T_k_k1``.
        geometry: the cells of the result.
    """
    there = valid_cells(vertices)
    T = np.asarray(T_a_b, dtype=np.float64)
    moved = se3.transform(T, vertices[:, there].T).astype(np.float32)
    winners = winner_map(moved, geometry)
    rotated = normals[:, there].T @ T[:3, :3].T.astype(np.float32)
    return gather(moved, winners), gather(rotated, winners)
