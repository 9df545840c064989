"""By how much a recording's angular rates are late against its attitudes: KITTI's are, others need not be."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from hybridlio.core.arrays import Array

_STEP_S = 0.1  # attitudes this far apart: long enough for the rates to show above the attitudes' noise
_GRID_S = np.arange(0.0, 0.121, 0.01)
_SLOW_S = 0.02
_LEAST_STEPS = 15
_CLEARLY_BETTER = 0.5  # of the squared error without a lag; KITTI's moving drives reach 0.11 to 0.26, one 0.47
_LEAST_TURN_RAD = 1e-4  # in a step; a vehicle that turns less is not moved wrongly by any lag
_EXPLAINED = 0.2  # of the squared rotations; KITTI's moving drives reach 0.001 to 0.08, those that stand 0.4 to 0.65


def gyro_lag_ns(stamps_ns: NDArray[np.int64], attitude_rad: Array, gyro_rad_s: Array) -> int:
    """The lag, in whole milliseconds, that makes integrated rates agree with the attitudes of the same rows.

    The rotations between attitudes 0.1 s apart are compared with the rates integrated over the same interval, moved
    by 0 to 0.12 s. A lag is found only where the rates explain the attitudes and do so clearly better than unmoved:
    the squared error must fall below half, and be below a fifth of the squared rotations. Otherwise, where they agree
    as they are, no attitudes are given, or the vehicle hardly turns or the recording is too short to tell, it is 0.

    Args:
        stamps_ns: ``(R,)`` int64, strictly increasing.
        attitude_rad: ``(R, 3)`` roll, pitch and yaw.
        gyro_rad_s: ``(R, 3)`` angular velocity along the body's axes.
    """
    if len(stamps_ns) < _LEAST_STEPS or not np.ptp(attitude_rad, axis=0).any():
        return 0
    seconds = (stamps_ns - stamps_ns[0]) / 1e9
    period = float(np.median(np.diff(seconds)))
    rows = np.arange(0, len(seconds), max(1, round(_STEP_S / period)))
    start, stop = seconds[rows[:-1]], seconds[rows[1:]]
    R = Rotation.from_euler("ZYX", attitude_rad[rows, ::-1])
    turned = (R[:-1].inv() * R[1:]).as_rotvec()
    # a line is off by an eighth of the squared period times the second derivative, so much only where rows are slow
    angle = make_interp_spline(seconds, gyro_rad_s, k=3 if period > _SLOW_S else 1).antiderivative()
    errors = np.array([turned - angle(stop + lag) + angle(start + lag) for lag in _GRID_S])
    whole = (stop - start < 1.5 * np.median(stop - start)) & (stop + _GRID_S[-1] <= seconds[-1])
    return _lag_ns(errors[:, whole], turned[whole])


def _lag_ns(errors: Array, turned: Array) -> int:
    """The best lag for ``errors`` ``(grid, S, 3)`` of the rotations ``turned`` ``(S, 3)``; 0 where none is clear."""
    if len(turned) < _LEAST_STEPS:
        return 0
    squared = ((errors - np.median(errors, axis=1, keepdims=True)) ** 2).sum(axis=-1)
    least = squared.min(axis=0)
    steady = least <= 25 * np.median(least)  # without jumps of the attitude, which no lag explains
    cost = squared[:, steady].mean(axis=1)
    motion = ((turned - np.median(turned, axis=0))[steady] ** 2).sum(axis=-1).mean()
    k = int(cost.argmin())
    clear = cost[k] < min(_CLEARLY_BETTER * cost[0], _EXPLAINED * motion)
    if motion < _LEAST_TURN_RAD**2 or not clear or not 0 < k < len(cost) - 1:
        return 0
    before, here, after = cost[k - 1 : k + 2]
    vertex = (before - after) / (2 * (before - 2 * here + after))  # of the parabola through the three
    return round(1e3 * float(_GRID_S[k] + vertex * (_GRID_S[1] - _GRID_S[0]))) * 1_000_000
