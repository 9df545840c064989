"""Taking out of a recorded path the rises and falls that its own attitude knows nothing of."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from hybridlio.core.arrays import Array

_STEP_M = 2.0
_IMPOSSIBLE, _DOUBTFUL = 0.15, 0.05  # slope that the path has over what the vehicle's pitch says


def without_false_rises(poses: Array) -> Array:
    """Lidar poses ``(N, 4, 4)``, z up, whose height climbs only where the vehicle points uphill.

    A navigation system that finds its height while the car hardly moves writes a cliff into the path: KITTI's 08 rises
    by 15 m in the first 40 m, level all the while. Where path and pitch differ by a slope of 15 % or more, and as far
    around as they differ by 5 %, the height is the pitch's; everything after is shifted. Other paths stay as they are.
    """
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(poses[:, :2, 3], axis=0), axis=1))])
    even = np.arange(0.0, s[-1] + _STEP_M, _STEP_M)
    height = np.interp(even, s, poses[:, 2, 3])
    pitch = np.interp(even[:-1] + _STEP_M / 2, s, poses[:, 2, 0] / np.linalg.norm(poses[:, :2, 0], axis=1))
    false = _false_cells(np.abs(np.diff(height) / _STEP_M - pitch))
    if not false.any():
        return poses
    rises = np.where(false, pitch * _STEP_M, np.diff(height))
    profile = height[0] + np.concatenate([[0.0], np.cumsum(rises)])
    cell = np.minimum((s / _STEP_M).astype(int), len(false) - 1)
    out = poses.copy()
    shifted = poses[:, 2, 3] + np.interp(s, even, profile - height)
    out[:, 2, 3] = np.where(false[cell], np.interp(s, even, profile), shifted)
    return out


def _false_cells(difference: Array) -> NDArray[np.bool_]:
    """Which cells ``(M,)`` of a path belong to a doubtful piece with an impossible place in it."""
    pieces, _ = label(difference > _DOUBTFUL)
    return np.asarray((pieces > 0) & np.isin(pieces, pieces[difference > _IMPOSSIBLE]))
