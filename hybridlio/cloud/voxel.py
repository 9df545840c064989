"""Voxel averages: thin a cloud to one point per cubic cell, or to a given number of points.

Source: UnDeepLIO, "Loss Function": the points of a voxel are replaced by their mean, and so are the normals, normalised
afterwards; the side is adjusted until K ± 100 points are left. The grid is anchored at the origin, results are ordered
by cell and do not depend on threads, so the same cloud always gives the same result.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridlio.core.arrays import Floats
from hybridlio.core.errors import ConfigError, DataError

_DENSE_CELLS = 1 << 23  # 8 MiB of flags: up to this number of cells a table of all is faster than sorting
_FINEST_M, _COARSEST_M = 1e-3, 1e5  # limits of the side: below the noise of any lidar, above the extent of any cloud
_BRACKET_CLOSED = 1e-5  # relative width at which the search for a side ends; 1e-5 of a side moves hardly any point


@dataclass(frozen=True, eq=False)
class VoxelCloud:
    """A thinned cloud.

    Attributes:
        points: ``(M, 3)`` float32, metres.
        normals: ``(M, 3)`` float32 unit normals, zero where a voxel has none; None where none were given.
        voxel_size_m: side of the voxels; 0 where the cloud was too small to need any.
    """

    points: Floats
    normals: Floats | None
    voxel_size_m: float

    def __len__(self) -> int:
        return len(self.points)


def voxel_average(points: ArrayLike, normals: ArrayLike | None, voxel_size_m: float) -> tuple[Floats, Floats | None]:
    """Return mean point ``(M, 3)`` and normalised mean normal ``(M, 3)`` of every occupied voxel.

    Args:
        points: ``(N, 3)`` metres; rows that are not finite are ignored.
        normals: ``(N, 3)`` or None; zero rows (no normal) are ignored, and a voxel with no other rows gets zero.
        voxel_size_m: side of the cubes.

    Raises:
        ConfigError: the side is not positive, or too small for the cloud's extent.
        DataError: points and normals differ in shape.
    """
    points, normals = _checked(points, normals)
    labels, count = voxel_labels(points, voxel_size_m)
    mean = label_means(points, labels, count)
    return mean, None if normals is None else _unit(_sums(normals, labels, count))


def voxel_pick(points: ArrayLike, voxel_size_m: float) -> NDArray[np.intp]:
    """Return indices ``(M,)`` of the points ``(N, 3)`` that are nearest to the mean of their voxel, one per voxel.

    In a corner the mean lies off both surfaces: means of large voxels, compared with those of small ones, seem farther
    from the walls than they are. A measured point has no such bias.

    Raises:
        ConfigError, DataError: as :func:`voxel_average`; here points must all be finite.
    """
    points = _checked(points, None)[0]
    labels, count = voxel_labels(points, voxel_size_m)
    offset = points - label_means(points, labels, count).take(labels, axis=0)
    distance2, least = np.einsum("ij,ij->i", offset, offset), np.full(count, np.inf, np.float32)
    np.minimum.at(least, labels, distance2)
    nearest = np.flatnonzero(distance2 <= least.take(labels))[::-1]
    picked = np.empty(count, np.intp)
    picked[labels[nearest]] = nearest  # reversed, so that of equally near points the first is written last and stays
    return picked


def voxel_labels(points: Floats, voxel_size_m: float) -> tuple[NDArray[np.intp], int]:
    """Label the finite points ``(N, 3)`` by their voxel, from 0 in the order of :func:`voxel_average`.

    Returns:
        the labels ``(N,)``, and the number of occupied voxels.
    """
    return _labels(*_keys(np.ascontiguousarray(points.T), voxel_size_m))


def label_means(values: Floats, labels: NDArray[np.intp], count: int) -> Floats:
    """Return the mean ``(M, C)`` of the values ``(N, C)`` of each of ``count`` labels, which must all occur."""
    return (_sums(values, labels, count) / np.bincount(labels, minlength=count)[:, None]).astype(np.float32)


def voxel_to_count(
    points: ArrayLike,
    normals: ArrayLike | None = None,
    count: int = 10240,
    tolerance: int = 100,
    start_size_m: float = 0.3,
) -> VoxelCloud:
    """Average the cloud over voxels of such a side that ``count`` ± ``tolerance`` points are left.

    The paper changes the side in steps of 0.01 m; bracketing and interpolation in logarithms need about four passes,
    which only count voxels. A cloud with fewer points is returned unchanged, with voxel size 0. If no side is found
    (few distinct places, or a tolerance below the jumps of the count), the nearest count found is used: check ``len``.

    Args:
        points, normals: as in :func:`voxel_average`.
        count, tolerance: number of points; by default the paper's K = 10,240 ± 100.
        start_size_m: side tried first, by default the paper's 0.3 m; the previous scan's side saves passes.

    Raises:
        ConfigError: count or side is not positive, or the tolerance is negative.
        DataError: points and normals differ in shape.
    """
    if count < 1 or tolerance < 0:
        raise ConfigError(f"voxels: count must be at least 1 and tolerance at least 0, got {count} and {tolerance}")
    points, normals = _checked(points, normals)
    if len(points) <= count + tolerance:
        return VoxelCloud(points, None if normals is None else _unit(normals), 0.0)
    size = _size_for(np.ascontiguousarray(points.T), count, tolerance, start_size_m)
    return VoxelCloud(*voxel_average(points, normals, size), size)


def _size_for(columns: Floats, count: int, tolerance: int, start_size_m: float) -> float:
    """Return a side that leaves ``count`` ± ``tolerance`` voxels, or the nearest found (regula falsi in logarithms)."""
    size, best, best_miss = start_size_m, start_size_m, math.inf
    fine: tuple[float, float] | None = None  # (log side, log of found / wanted) with too many voxels
    coarse: tuple[float, float] | None = None  # the same with too few
    while not (fine and coarse and coarse[0] - fine[0] < _BRACKET_CLOSED):
        found = _count(columns, size)
        if abs(found - count) < best_miss:
            best, best_miss = size, abs(found - count)
        if best_miss <= tolerance or (found < count and size <= _FINEST_M) or (found > count and size >= _COARSEST_M):
            break
        here = (math.log(size), math.log(found / count))
        fine, coarse = (here, coarse) if found > count else (fine, here)
        if fine and coarse:
            # zero of the line through both, away from the ends so that the bracket shrinks on both sides
            share = min(max(fine[1] / (fine[1] - coarse[1]), 0.1), 0.9)
            size = math.exp(fine[0] + share * (coarse[0] - fine[0]))
        else:
            # the count falls with the square of the side on surfaces, and less where voxels hold single points
            size = max(size * math.exp(min(max(here[1] / 1.5, -1.0), 1.0)), _FINEST_M)
    return best


def _checked(points: ArrayLike, normals: ArrayLike | None) -> tuple[Floats, Floats | None]:
    points = np.asarray(points, dtype=np.float32)
    if points.ndim != 2 or points.shape[1] != 3:
        raise DataError(f"voxels: points must be (N, 3), got {points.shape}")
    if normals is not None:
        normals = np.asarray(normals, dtype=np.float32)
        if normals.shape != points.shape:
            raise DataError(
                f"voxels: normals have shape {normals.shape} and points {points.shape}; give one normal per point"
            )
    if np.isfinite(points).all():  # the usual case, and cheaper than a flag per row
        return points, normals
    finite = np.isfinite(points).all(axis=1)
    return points[finite], None if normals is None else normals[finite]


def _keys(columns: Floats, voxel_size_m: float) -> tuple[NDArray[np.int32] | NDArray[np.int64], int]:
    """Return an integer for the voxel of each of the points ``(3, N)``, and the number of voxels in the cloud's box."""
    if not (math.isfinite(voxel_size_m) and voxel_size_m > 0):
        raise ConfigError(f"voxel size must be positive, got {voxel_size_m}")
    if not columns.shape[1]:
        return np.empty(0, np.int32), 0
    cells = columns / np.float32(voxel_size_m)
    np.floor(cells, out=cells)
    low = cells.min(axis=1)
    nx, ny, nz = (int(n) + 1 for n in cells.max(axis=1).astype(np.float64) - low)
    if nx * ny * nz >= 1 << 62:
        raise ConfigError(f"voxels of {voxel_size_m} m are too small: the cloud's box holds {nx} x {ny} x {nz} of them")
    x, y, z = (cells - low[:, None]).astype(np.int32 if nx * ny * nz < 1 << 31 else np.int64)
    return (z * ny + y) * nx + x, nx * ny * nz


def _count(columns: Floats, voxel_size_m: float) -> int:
    keys, cells = _keys(columns, voxel_size_m)
    if cells > _DENSE_CELLS:
        return len(np.unique(keys))
    occupied = np.zeros(cells, bool)
    occupied[keys] = True
    return int(np.count_nonzero(occupied))


def _labels(keys: NDArray[np.int32] | NDArray[np.int64], cells: int) -> tuple[NDArray[np.intp], int]:
    if cells > _DENSE_CELLS:
        unique, inverse = np.unique(keys, return_inverse=True)
        return inverse, len(unique)
    occupied = np.zeros(cells, bool)
    occupied[keys] = True
    present = np.flatnonzero(occupied)
    number = np.empty(cells, np.int32)  # written and read at occupied cells only
    number[present] = np.arange(len(present), dtype=np.int32)
    return number.take(keys).astype(np.intp), len(present)


def _sums(values: Floats, labels: NDArray[np.intp], count: int) -> NDArray[np.float64]:
    """Return sums per label by a sparse matrix: twice as fast as a bincount per column, and in the same order."""
    from scipy.sparse import csc_array  # late: slow to import

    ones = csc_array((np.ones(len(values)), labels, np.arange(len(values) + 1)), shape=(count, len(values)))
    return np.asarray(ones @ values.astype(np.float64))


def _unit(vectors: NDArray[np.float32] | NDArray[np.float64]) -> Floats:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return (vectors / np.where(length > 1e-6, length, np.inf)).astype(np.float32)
