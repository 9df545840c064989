"""Find the voxels of moving objects: those that scans at other times see through.

Each scan becomes a range image of square pixels. A voxel of the map is seen through if all returns in and around its
pixel lie behind it. One pixel around it, because at a grazing angle and at edges the range changes by metres within a
pixel; a pixel without a return says nothing (the sky, or the gap between two beams).
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import minimum_filter

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Floats
from hybridlio.mapping.voxel_tiles import Voxels, VoxelTiles

PIXEL_RAD = np.radians(0.5)  # about the distance between beams of a lidar of 64; finer pixels have no return in them
RANGE_M = 40.0  # beyond it a pixel is over 0.35 m wide, as wide as a person
_MARGIN_VOXELS, _MARGIN_SHARE = 3.0, 0.01  # of the voxel's side, and of the range: half of PIXEL_RAD, rounded up
_MIN_PASSES = 2  # a single scan may be registered wrongly
_ROWS, _COLUMNS = round(np.pi / PIXEL_RAD), round(2 * np.pi / PIXEL_RAD)


def vote(tiles: VoxelTiles, points: Floats, T_world_lidar: Array, range_m: float = RANGE_M) -> None:
    """Count for the voxels around a scan whether it sees a surface in them or sees through them.

    Args:
        tiles: the map.
        points: ``(N, 3)`` the scan's points, motion compensated, lidar frame.
        T_world_lidar: ``(4, 4)`` at the scan's stamp.
        range_m: distance up to which voxels are compared.
    """
    image = _range_image(points)
    nearest = np.full_like(image, np.inf)
    minimum_filter(image, size=3, output=nearest, mode=("nearest", "wrap"))
    T_lidar_world = se3.inverse(T_world_lidar)
    for tile in tiles.near(T_world_lidar[:3, 3], range_m):
        voxels = tiles.voxels(tile)
        at = tiles.grid.means(voxels) - T_world_lidar[:3, 3]
        inside = np.flatnonzero(np.einsum("ij,ij->i", at, at) < range_m**2)
        row, column, distance = _pixels((at[inside] @ T_lidar_world[:3, :3].T).astype(np.float32))
        seen = image[row, column]
        margin = _MARGIN_VOXELS * tiles.grid.voxel_m + _MARGIN_SHARE * distance
        with np.errstate(invalid="ignore"):  # inf - inf where nothing returned
            passed = np.isfinite(seen) & (distance < nearest[row, column] - margin)
            agreed = np.abs(seen - distance) <= margin
        _count(voxels, "passes", inside[passed])
        _count(voxels, "agrees", inside[agreed])


def is_moving(voxels: Voxels) -> np.ndarray:
    """Return ``(M,)`` whether more scans see through a voxel than see a surface in it."""
    return np.asarray((voxels["passes"] >= _MIN_PASSES) & (voxels["passes"] > voxels["agrees"]))


def _range_image(points: Floats) -> Floats:
    """Return the least range ``(rows, columns)`` of each pixel, infinite where there is no return."""
    image = np.full((_ROWS, _COLUMNS), np.inf, np.float32)
    row, column, distance = _pixels(points)
    np.minimum.at(image, (row, column), distance)
    return image


def _pixels(points: Floats) -> tuple[np.ndarray, np.ndarray, Floats]:
    """Return row, column and range ``(N,)`` of points ``(N, 3)`` in the lidar frame."""
    distance = np.linalg.norm(points, axis=1)
    elevation = np.arcsin(np.clip(points[:, 2] / np.maximum(distance, 1e-6), -1, 1))
    row = np.clip(((elevation + np.pi / 2) / PIXEL_RAD).astype(np.int64), 0, _ROWS - 1)
    column = ((np.arctan2(points[:, 1], points[:, 0]) + np.pi) / PIXEL_RAD).astype(np.int64) % _COLUMNS
    return row, column, distance


def _count(voxels: Voxels, name: str, rows: np.ndarray) -> None:
    counts = voxels[name]
    counts[rows] = np.minimum(counts[rows].astype(np.int64) + 1, np.iinfo(counts.dtype).max)
