"""One world, one ground: evening out the heights at which a recorded path comes back to a place."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.sparse import coo_matrix, diags, identity
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

_NEAR_M = 8.0
_APART_M = 60.0
_STEP_M = 2.0
_FLATNESS, _SMOOTHNESS = 300.0, 3.0e3  # of the change, against one pair's agreement
_ROUND_OFF_M = 4.0


def level_revisits(poses: Array) -> Array:
    """Poses ``(N, 4, 4)`` whose heights agree where the path comes within some metres of where it was before.

    Recorded truth drifts in height, by metres in some of KITTI's drives, and a world has only one ground. The smoothest
    change of height that makes the visits agree is added, with the change of slope that belongs to it. Positions in
    the plane stay, and a path that comes back to nowhere stays as it is.
    """
    xy = poses[:, :2, 3]
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))])
    even = np.arange(0.0, s[-1] + _STEP_M, _STEP_M)
    places = np.column_stack([np.interp(even, s, poses[:, i, 3]) for i in range(3)])
    pairs = cKDTree(places[:, :2]).query_pairs(_NEAR_M, output_type="ndarray")
    pairs = pairs[pairs[:, 1] - pairs[:, 0] > _APART_M / _STEP_M]
    if not len(pairs):
        return poses
    correction = gaussian_filter1d(_correction(places[:, 2], pairs), _ROUND_OFF_M / _STEP_M, mode="nearest")
    slope = np.interp(s, even, np.gradient(correction, _STEP_M))
    levelled = poses.copy()
    levelled[:, 2, 3] += np.interp(s, even, correction)
    levelled[:, :3, :3] = _tilts(poses[:, :2, 0], slope) @ poses[:, :3, :3]
    return levelled


def _correction(height: Array, pairs: NDArray[np.intp]) -> Array:
    """The smooth change ``(M,)`` of height that makes ``pairs`` ``(P, 2)`` agree, by least squares."""
    count, rows = len(height), np.arange(len(pairs))
    ones = np.ones(len(pairs))
    cells = (np.concatenate([rows, rows]), pairs.T.ravel())
    gap = coo_matrix((np.concatenate([-ones, ones]), cells), shape=(len(pairs), count)).tocsr()
    bend = diags([1.0, -2.0, 1.0], [0, 1, 2], shape=(count - 2, count))
    rise = diags([-1.0, 1.0], [0, 1], shape=(count - 1, count))
    stiffness = _FLATNESS / _STEP_M**2 * (rise.T @ rise) + _SMOOTHNESS / _STEP_M**4 * (bend.T @ bend)
    normal = gap.T @ gap + stiffness + 1e-6 * identity(count)
    return np.asarray(spsolve(normal.tocsc(), -(gap.T @ (gap @ height))))


def _tilts(ahead: Array, slope: Array) -> Array:
    """Rotations ``(N, 3, 3)`` in world that raise the direction ``ahead`` ``(N, 2)`` by ``slope``."""
    length = np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
    left = np.column_stack([-ahead[:, 1], ahead[:, 0], np.zeros(len(ahead))]) / length
    return np.asarray(Rotation.from_rotvec(-np.arctan(slope)[:, None] * left).as_matrix())
