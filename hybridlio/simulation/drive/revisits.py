"""One world, one ground: evening out the heights at which a recorded path comes back to a place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.sparse import coo_matrix, csr_matrix, diags, identity
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from hybridlio.core.arrays import Array

_SAME_ROAD_M = 8.0
_BESIDE_M = 45.0
_APART_M = 60.0
_STEP_M = 2.0
_FLATNESS, _SMOOTHNESS = 300.0, 3.0e3  # of the change, against one pair's agreement
_ROUND_OFF_M = 4.0
_STEEPEST, _UNEVEN_M = 0.15, 0.1  # of land between one road and another beside it
_CLOSE_ENOUGH_M, _ROUNDS = 0.02, 300


def level_revisits(poses: Array) -> Array:
    """Poses ``(N, 4, 4)`` whose heights agree where the path comes near to where it was before.

    Recorded truth drifts in height, by metres in some of KITTI's drives, and a world has only one ground. The smoothest
    change of height is added that makes visits to the same road agree, and leaves between it and a road beside it no
    more than a slope of 15 %, with the change of slope that belongs to it. Positions in the plane stay, and a path
    that comes back to nowhere stays as it is.
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
    """Pairs of places near each other and far from each other along the path.

    Attributes:
        gap: ``(P, M)``; times the heights of all places, how much higher each pair's later one is.
        apart_m: ``(P,)`` in the plane.
    """

    gap: csr_matrix
    apart_m: Array

    @classmethod
    def of(cls, places: Array) -> _Visits:
        """Those among ``places`` ``(M, 3)``, ``_STEP_M`` apart."""
        pairs = cKDTree(places[:, :2]).query_pairs(_BESIDE_M, output_type="ndarray")
        pairs = pairs[pairs[:, 1] - pairs[:, 0] > _APART_M / _STEP_M]
        rows, ones = np.arange(len(pairs)), np.ones(len(pairs))
        cells = (np.concatenate([rows, rows]), pairs.T.ravel())
        gap = coo_matrix((np.concatenate([-ones, ones]), cells), shape=(len(pairs), len(places))).tocsr()
        return cls(gap, np.linalg.norm(places[pairs[:, 1], :2] - places[pairs[:, 0], :2], axis=1))


def _correction(height: Array, visits: _Visits) -> Array:
    """The smooth change ``(M,)`` of ``height`` that levels the visits.

    Least squares over those of the same road; where that leaves more between two places than land has, within these
    bounds by the alternating direction method of multipliers (Boyd et al. 2011, section 5.2).
    """
    same = visits.gap[visits.apart_m < _SAME_ROAD_M]
    normal, pull = same.T @ same + _stiffness(len(height)), -(same.T @ (same @ height))
    change = np.asarray(splu(normal.tocsc()).solve(pull))
    most = _UNEVEN_M + _STEEPEST * visits.apart_m
    before = visits.gap @ height
    after = before + visits.gap @ change
    if (np.abs(after) < most + _CLOSE_ENOUGH_M).all():
        return change
    bounded = splu((normal + visits.gap.T @ visits.gap).tocsc())
    excess = np.zeros(len(most))
    for _ in range(_ROUNDS):
        allowed = np.clip(after + excess, -most, most)
        excess += after - allowed
        change = np.asarray(bounded.solve(pull + visits.gap.T @ (allowed - excess - before)))
        after = before + visits.gap @ change
        if (np.abs(after) < most + _CLOSE_ENOUGH_M).all():
            break
    return change


def _stiffness(count: int) -> csr_matrix:
    """What bends and slopes of a change at ``count`` places cost."""
    bend = diags([1.0, -2.0, 1.0], [0, 1, 2], shape=(count - 2, count))
    rise = diags([-1.0, 1.0], [0, 1], shape=(count - 1, count))
    stiffness = _FLATNESS / _STEP_M**2 * (rise.T @ rise) + _SMOOTHNESS / _STEP_M**4 * (bend.T @ bend)
    return stiffness + 1e-6 * identity(count)


def _tilts(ahead: Array, slope: Array) -> Array:
    """Rotations ``(N, 3, 3)`` in world that raise the direction ``ahead`` ``(N, 2)`` by ``slope``."""
    length = np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
    left = np.column_stack([-ahead[:, 1], ahead[:, 0], np.zeros(len(ahead))]) / length
    return np.asarray(Rotation.from_rotvec(-np.arctan(slope)[:, None] * left).as_matrix())
