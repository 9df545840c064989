"""Correction of recorded heights, so that a path that returns to a place returns at the same height."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.sparse import coo_matrix, csr_matrix, diags, identity
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from hybridlio.core.arrays import Array

_SAME_ROAD_M = 8.0  # two lanes of 3.5 m, and the error of recorded positions
_BESIDE_M = 45.0  # between roads nearer than this the lidar sees the ground of both
_MIN_APART_M = 60.0  # along the path, between places that count as two visits
_STEP_M = 2.0  # between places: less than the length of any rise
# Weights of slope and bend of the correction against the agreement of one pair of places: the correction is smooth over
# about ten metres. Checked on KITTI's paths: the lidar stays within 0.3 m of its height above ground (test_heights.py).
_FLATNESS, _SMOOTHNESS = 300.0, 3.0e3
_ROUND_OFF_M = 4.0  # smooths the corners that the bounds leave in the correction
_MAX_LAND_SLOPE, _MAX_LAND_STEP_M = 0.15, 0.1  # of the ground between a road and another beside it
_TOLERANCE_M, _MAX_ITERATIONS = 0.02, 300  # of the bounds; after the last iteration the result is used as it is
_REGULARISATION = 1e-6  # makes the system definite: a constant correction costs nothing otherwise


def level_revisits(poses: Array) -> Array:
    """Return poses ``(N, 4, 4)`` whose heights agree where the path returns to a place.

    Recorded heights drift, by metres in some of KITTI's drives, but the world has one ground. The smoothest correction
    is added that makes visits to the same road agree, and that leaves at most a slope of 15 % to a road beside it.
    Attitudes are tilted with the correction's slope. Horizontal positions stay. A path without revisits is returned
    unchanged.
    """
    xy = poses[:, :2, 3]
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))])
    even = np.arange(0.0, s[-1] + _STEP_M, _STEP_M)
    places = np.column_stack([np.interp(even, s, poses[:, i, 3]) for i in range(3)])
    visits = _Visits.of(places)
    if not len(visits.apart_m):
        return poses
    correction = gaussian_filter1d(_correction(places[:, 2], visits), _ROUND_OFF_M / _STEP_M, mode="nearest")
    slope = np.interp(s, even, np.gradient(correction, _STEP_M))
    levelled = poses.copy()
    levelled[:, 2, 3] += np.interp(s, even, correction)
    levelled[:, :3, :3] = _tilts(poses[:, :2, 0], slope) @ poses[:, :3, :3]
    return levelled


@dataclass(frozen=True, eq=False)
class _Visits:
    """``P`` pairs of places that are near each other, but far from each other along the path.

    Attributes:
        gap: ``(P, M)``; times the heights of all places, it gives the height of each pair's later place over the other.
        apart_m: ``(P,)`` horizontal distances.
    """

    gap: csr_matrix
    apart_m: Array

    @classmethod
    def of(cls, places: Array) -> _Visits:
        """Find the pairs among ``places`` ``(M, 3)``, which are ``_STEP_M`` apart along the path."""
        pairs = cKDTree(places[:, :2]).query_pairs(_BESIDE_M, output_type="ndarray")
        pairs = pairs[pairs[:, 1] - pairs[:, 0] > _MIN_APART_M / _STEP_M]
        rows, ones = np.arange(len(pairs)), np.ones(len(pairs))
        cells = (np.concatenate([rows, rows]), pairs.T.ravel())
        gap = coo_matrix((np.concatenate([-ones, ones]), cells), shape=(len(pairs), len(places))).tocsr()
        return cls(gap, np.linalg.norm(places[pairs[:, 1], :2] - places[pairs[:, 0], :2], axis=1))


def _correction(height: Array, visits: _Visits) -> Array:
    """Return the smooth correction ``(M,)`` of ``height`` that makes the visits agree.

    Solves least squares over pairs on the same road. If the result exceeds the largest difference that the land between
    two roads can have, it is bounded by the alternating direction method of multipliers (Boyd et al., "Distributed
    optimization and statistical learning via ADMM", 2011, section 5.2).
    """
    same = visits.gap[visits.apart_m < _SAME_ROAD_M]
    normal, pull = same.T @ same + _stiffness(len(height)), -(same.T @ (same @ height))
    change = np.asarray(splu(normal.tocsc()).solve(pull))
    bound = _MAX_LAND_STEP_M + _MAX_LAND_SLOPE * visits.apart_m
    before = visits.gap @ height
    after = before + visits.gap @ change
    if (np.abs(after) < bound + _TOLERANCE_M).all():
        return change
    bounded = splu((normal + visits.gap.T @ visits.gap).tocsc())
    excess = np.zeros(len(bound))  # the scaled dual variable
    for _ in range(_MAX_ITERATIONS):
        allowed = np.clip(after + excess, -bound, bound)
        excess += after - allowed
        change = np.asarray(bounded.solve(pull + visits.gap.T @ (allowed - excess - before)))
        after = before + visits.gap @ change
        if (np.abs(after) < bound + _TOLERANCE_M).all():
            break
    return change


def _stiffness(count: int) -> csr_matrix:
    """Return the matrix ``(count, count)`` of the cost of slopes and bends of a correction."""
    bend = diags([1.0, -2.0, 1.0], [0, 1, 2], shape=(count - 2, count))
    rise = diags([-1.0, 1.0], [0, 1], shape=(count - 1, count))
    stiffness = _FLATNESS / _STEP_M**2 * (rise.T @ rise) + _SMOOTHNESS / _STEP_M**4 * (bend.T @ bend)
    return stiffness + _REGULARISATION * identity(count)


def _tilts(ahead: Array, slope: Array) -> Array:
    """Return rotations ``(N, 3, 3)`` in world that raise the directions ``ahead`` ``(N, 2)`` by ``slope`` ``(N,)``."""
    length = np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
    left = np.column_stack([-ahead[:, 1], ahead[:, 0], np.zeros(len(ahead))]) / length
    return np.asarray(Rotation.from_rotvec(-np.arctan(slope)[:, None] * left).as_matrix())
