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
    from hybridlio.cloud import voxel_loops  # late: compiled

    points, normals = _checked(points, normals)
    labels, order = _unordered_labels(points, voxel_size_m)
    mean = label_means(points, labels, len(order))[order]
    return mean, None if normals is None else _unit(voxel_loops.sums(normals, labels, len(order))[0][order])


def voxel_pick(points: ArrayLike, voxel_size_m: float) -> NDArray[np.int64]:
    """Return indices ``(M,)`` of the points ``(N, 3)`` that are nearest to the mean of their voxel, one per voxel.

    In a corner the mean lies off both surfaces: means of large voxels, compared with those of small ones, seem farther
    from the walls than they are. A measured point has no such bias.

    Raises:
        ConfigError, DataError: as :func:`voxel_average`; here points must all be finite.
    """
    from hybridlio.cloud import voxel_loops  # late: compiled

    points = _checked(points, None)[0]
    labels, order = _unordered_labels(points, voxel_size_m)
    return voxel_loops.nearest_to(label_means(points, labels, len(order)), points, labels)[order]


def voxel_labels(points: Floats, voxel_size_m: float) -> tuple[NDArray[np.int64], int]:
    """Label the finite points ``(N, 3)`` by their voxel, from 0 in the order of :func:`voxel_average`.

    Returns:
        the labels ``(N,)``, and the number of occupied voxels.
    """
    labels, order = _unordered_labels(points, voxel_size_m)
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    return rank.take(labels), len(order)


def voxel_count(points: Floats, voxel_size_m: float) -> int:
    """Return the number of voxels that hold any of the finite points ``(N, 3)``."""
    return len(_unordered_keys(points, voxel_size_m)[1])


def label_means(values: Floats, labels: NDArray[np.int64], count: int) -> Floats:
    """Return the mean ``(M, C)`` of the values ``(N, C)`` of each of ``count`` labels, which must all occur."""
    from hybridlio.cloud import voxel_loops  # late: compiled

    total, members = voxel_loops.sums(np.ascontiguousarray(values), labels, count)
    return (total / members[:, None]).astype(np.float32)


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
    size = _size_for(points, count, tolerance, start_size_m)
    return VoxelCloud(*voxel_average(points, normals, size), size)


def _size_for(points: Floats, count: int, tolerance: int, start_size_m: float) -> float:
    """Return a side that leaves ``count`` ± ``tolerance`` voxels, or the nearest found (regula falsi in logarithms)."""
    size, best, best_miss = start_size_m, start_size_m, math.inf
    fine: tuple[float, float] | None = None  # (log side, log of found / wanted) with too many voxels
    coarse: tuple[float, float] | None = None  # the same with too few
    while not (fine and coarse and coarse[0] - fine[0] < _BRACKET_CLOSED):
        found = voxel_count(points, size)
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


def _unordered_labels(points: Floats, voxel_size_m: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Label points ``(N, 3)`` by their voxel, in any order; return also the labels ``(M,)`` in the voxels' order."""
    labels, keys = _unordered_keys(points, voxel_size_m)
    return labels, np.argsort(keys)


def _unordered_keys(points: Floats, voxel_size_m: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Label points ``(N, 3)`` by their voxel, in any order; return also the voxels' keys ``(M,)``."""
    from hybridlio.cloud import voxel_loops  # late: compiled

    if not (math.isfinite(voxel_size_m) and voxel_size_m > 0):
        raise ConfigError(f"voxel size must be positive, got {voxel_size_m}")
    side_m, points = np.float32(voxel_size_m), np.ascontiguousarray(points)
    if not len(points):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    low, high = voxel_loops.extent(points, side_m)
    nx, ny, _ = _cell_counts(low, high, voxel_size_m)
    return voxel_loops.label(points, side_m, low, ny, nx)


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


def _cell_counts(low: Floats, high: Floats, voxel_size_m: float) -> tuple[int, int, int]:
    """Return the number of cells along each axis of a cloud's box, from its lowest to its highest cell."""
    nx, ny, nz = (int(n) + 1 for n in high.astype(np.float64) - low)
    if nx * ny * nz >= 1 << 62:
        raise ConfigError(f"voxels of {voxel_size_m} m are too small: the cloud's box holds {nx} x {ny} x {nz} of them")
    return nx, ny, nz


def _unit(vectors: NDArray[np.float32] | NDArray[np.float64]) -> Floats:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return (vectors / np.where(length > 1e-6, length, np.inf)).astype(np.float32)
