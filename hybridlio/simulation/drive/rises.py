"""Removal of height changes in a recorded path that contradict the vehicle's pitch."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import label

from hybridlio.core.arrays import Array, Mask

_STEP_M = 2.0  # cells along the path: short against any hill, long enough that noise of heights is a small slope
# Slope of the path beyond the vehicle's pitch. A car on its springs pitches by 1 to 2°, so 15 % (8.5°) is an error of
# the record; its extent is found at 5 % (3°). KITTI's 08 needs this, 00 passes unchanged (test_heights.py).
_IMPOSSIBLE_SLOPE, _DOUBTFUL_SLOPE = 0.15, 0.05


def without_false_rises(poses: Array) -> Array:
    """Return lidar poses ``(N, 4, 4)``, z up, that climb only where the vehicle points uphill.

    A navigation system whose height converges while the car hardly moves records a cliff: KITTI's 08 rises by 15 m in
    the first 40 m, with a level car. Where path and pitch differ by a slope of 15 % or more, and around that as far as
    they differ by 5 %, the height is integrated from the pitch instead, and all later heights are shifted. Other paths
    are returned unchanged.
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


def _false_cells(difference: Array) -> Mask:
    """Return ``(M,)``, true for cells of a doubtful piece that contains an impossible cell."""
    pieces, _ = label(difference > _DOUBTFUL_SLOPE)
    return np.asarray((pieces > 0) & np.isin(pieces, pieces[difference > _IMPOSSIBLE_SLOPE]))
