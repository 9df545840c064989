"""Voxel averages: a cloud thinned to one point a cubic cell, or to a wanted number of points.

Source: UnDeepLIO, "Loss Function": the arithmetic average of all points in a voxel stands for them, normals likewise
and normalised afterwards; the side is adjusted until K ± 100 points are left. The grid is anchored at the origin,
results are ordered by cell, and nothing depends on threads, so the same cloud always gives the same result.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridlio.core.arrays import Floats
from hybridlio.core.errors import ConfigError, DataError

_DENSE_CELLS = 1 << 23  # up to so many, a table of all cells beats sorting the occupied ones
_FINEST_M, _COARSEST_M = 1e-3, 1e5
_NARROW = 1e-5  # relative width at which a bracket is at its end


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
    """Mean point ``(M, 3)`` and mean normal ``(M, 3)``, normalised, of every voxel that holds points.

    Args:
        points: ``(N, 3)`` metres; rows that are not finite are left out.
        normals: ``(N, 3)`` or None; zero rows (no normal) count for nothing, and a voxel of nothing else gets zero.
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
    """Numbers ``(M,)`` of the points ``(N, 3)`` that lie nearest to the mean of their voxel's, one a voxel.

    In a corner the mean lies off both surfaces: means of large voxels, held against those of small ones, seem to lie
    farther from the walls than they do. A point that was there before lies where the others do.

    Raises:
        ConfigError, DataError: as :func:`voxel_average`; here points must all be finite.
    """
    points = _checked(points, None)[0]
    labels, count = voxel_labels(points, voxel_size_m)
    off = points - label_means(points, labels, count).take(labels, axis=0)
    off2, least = np.einsum("ij,ij->i", off, off), np.full(count, np.inf, np.float32)
    np.minimum.at(least, labels, off2)
    nearest = np.flatnonzero(off2 <= least.take(labels))[::-1]
    picked = np.empty(count, np.intp)
    picked[labels[nearest]] = nearest  # of several as near, the first: the last that is written
    return picked


def voxel_labels(points: Floats, voxel_size_m: float) -> tuple[NDArray[np.intp], int]:
    """Which voxel each of the finite points ``(N, 3)`` lies in: numbers from 0, in the order of :func:`voxel_average`.

    Returns:
        the labels ``(N,)``, and how many voxels hold points.
    """
    return _labels(*_keys(np.ascontiguousarray(points.T), voxel_size_m))


def label_means(values: Floats, labels: NDArray[np.intp], count: int) -> Floats:
    """Mean ``(M, C)`` of the values ``(N, C)`` that share a label, of ``count`` labels that all occur."""
    return (_sums(values, labels, count) / np.bincount(labels, minlength=count)[:, None]).astype(np.float32)


def voxel_to_count(
    points: ArrayLike,
    normals: ArrayLike | None = None,
    count: int = 10240,
    tolerance: int = 100,
    start_size_m: float = 0.3,
) -> VoxelCloud:
    """Average the cloud over voxels of that side which leaves ``count`` ± ``tolerance`` points.

    The paper steps the side by 0.01 m; bracketing and interpolating in logarithms gets there in about four passes,
    which only count. A cloud of fewer points than wanted comes back as it is, with a voxel size of 0. Where no side is
    found (a cloud of few distinct places; a tolerance below the jumps that the count makes), the nearest count found
    stands: look at ``len`` of the result.

    Args:
        points, normals: as :func:`voxel_average`.
        count, tolerance: the paper's K = 10,240 ± 100.
        start_size_m: first side tried; the paper's 0.3 m. The last scan's saves passes.

    Raises:
        ConfigError: count or side is not positive, or the tolerance is negative.
        DataError: points and normals differ in shape.
    """
    if count < 1 or tolerance < 0:
        raise ConfigError(f"voxel count must be at least 1 and its tolerance at least 0, got {count} and {tolerance}")
    points, normals = _checked(points, normals)
    if len(points) <= count + tolerance:
        return VoxelCloud(points, None if normals is None else _unit(normals), 0.0)
    size = _size_for(np.ascontiguousarray(points.T), count, tolerance, start_size_m)
    return VoxelCloud(*voxel_average(points, normals, size), size)


def _size_for(columns: Floats, count: int, tolerance: int, start_size_m: float) -> float:
    """The side that leaves ``count`` ± ``tolerance`` voxels, or the best that was met."""
    size, best, best_miss = start_size_m, start_size_m, math.inf
    fine: tuple[float, float] | None = None  # (log side, log of count over wanted) where too many are left
    coarse: tuple[float, float] | None = None  # and where too few are
    while not (fine and coarse and coarse[0] - fine[0] < _NARROW):
        found = _count(columns, size)
        if abs(found - count) < best_miss:
            best, best_miss = size, abs(found - count)
        if best_miss <= tolerance or (found < count and size <= _FINEST_M) or (found > count and size >= _COARSEST_M):
            break
        here = (math.log(size), math.log(found / count))
        fine, coarse = (here, coarse) if found > count else (fine, here)
        if fine and coarse:
            # the zero of the line between them, kept off the ends so that the bracket shrinks
            share = min(max(fine[1] / (fine[1] - coarse[1]), 0.1), 0.9)
            size = math.exp(fine[0] + share * (coarse[0] - fine[0]))
        else:
            # on surfaces the count falls with the square of the side, less where voxels hold one point each
            size = max(size * math.exp(min(max(here[1] / 1.5, -1.0), 1.0)), _FINEST_M)
    return best


def _checked(points: ArrayLike, normals: ArrayLike | None) -> tuple[Floats, Floats | None]:
    points = np.asarray(points, dtype=np.float32)
    if points.ndim != 2 or points.shape[1] != 3:
        raise DataError(f"voxels: points must be (N, 3), got {points.shape}")
    if normals is not None:
        normals = np.asarray(normals, dtype=np.float32)
        if normals.shape != points.shape:
            raise DataError(f"voxels: normals {normals.shape} do not go with points {points.shape}; give one a point")
    if np.isfinite(points).all():  # by far the common case, and cheaper than a flag a row
        return points, normals
    finite = np.isfinite(points).all(axis=1)
    return points[finite], None if normals is None else normals[finite]


def _keys(columns: Floats, voxel_size_m: float) -> tuple[NDArray[np.int32] | NDArray[np.int64], int]:
    """One integer a point that tells its voxel, and how many voxels the cloud's box has; of points ``(3, N)``."""
    if not (math.isfinite(voxel_size_m) and voxel_size_m > 0):
        raise ConfigError(f"voxel size must be positive, got {voxel_size_m}")
    if not columns.shape[1]:
        return np.empty(0, np.int32), 0
    cells = columns / np.float32(voxel_size_m)
    np.floor(cells, out=cells)
    low = cells.min(axis=1)
    nx, ny, nz = (int(n) + 1 for n in cells.max(axis=1).astype(np.float64) - low)
    if nx * ny * nz >= 1 << 62:
        raise ConfigError(f"voxels of {voxel_size_m} m are too small for a cloud of {nx} x {ny} x {nz} of them")
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
    """By a sparse matrix of ones, which takes half as long as a bincount for each column and adds in the same order."""
    from scipy.sparse import csc_array  # late: it takes a while to load

    ones = csc_array((np.ones(len(values)), labels, np.arange(len(values) + 1)), shape=(count, len(values)))
    return np.asarray(ones @ values.astype(np.float64))


def _unit(vectors: NDArray[np.float32] | NDArray[np.float64]) -> Floats:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return (vectors / np.where(length > 1e-6, length, np.inf)).astype(np.float32)
