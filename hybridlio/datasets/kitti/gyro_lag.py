"""The lag of a recording's angular rates against its attitudes.

The angular rates in KITTI's navigation rows are 53 to 58 ms late; those of other recordings in KITTI's layout need not
be. So the lag is estimated from each recording's own rows.
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from hybridlio.core.arrays import Array, Stamps
from hybridlio.core.sensors import NS_PER_S

# Rows farther apart are slow: KITTI's synchronised rows have 10 Hz, its unsynchronised recordings 100 Hz.
SLOW_ROWS_S = 0.02

_NS_PER_MS = NS_PER_S // 1000

_STEP_S = 0.1  # between compared attitudes: long enough for rotations to exceed the attitudes' noise
_GRID_S = np.arange(0.0, 0.121, 0.01)  # lags that are tried: up to twice KITTI's
_MIN_STEPS = 15  # 1.5 s; two fitted parameters, lag and bias, need many times more rotations
# Both shares separate KITTI's 44 moving drives from its standing ones and from recordings without lag.
_MAX_ERROR_SHARE = 0.5  # of the squared error without lag; the moving drives reach 0.11 to 0.26, one of them 0.47
_MAX_UNEXPLAINED = 0.2  # of the squared rotations; the moving drives reach 0.001 to 0.08, the standing ones 0.4 to 0.65
_MIN_ROTATION_RAD = 1e-4  # rms per step: if a vehicle turns less, a wrong lag does no harm
_MAX_ERROR_RATIO = 25.0  # squared error over the median one, above which a step is an attitude jump: 5 deviations


def gyro_lag_ns(stamps_ns: Stamps, attitude_rad: Array, gyro_rad_s: Array) -> int:
    """Estimate the lag of angular rates against the attitudes of the same rows.

    Rotations between attitudes 0.1 s apart are compared with the integral of the rates over the same interval, shifted
    by 0 to 0.12 s. A lag counts only if the shifted rates explain the rotations, and clearly better than unshifted
    rates: the squared error must fall below half, and below a fifth of the squared rotations.

    Args:
        stamps_ns: ``(R,)`` int64, strictly increasing.
        attitude_rad: ``(R, 3)`` roll, pitch and yaw.
        gyro_rad_s: ``(R, 3)`` angular velocity in the body frame.

    Returns:
        The lag, rounded to milliseconds. 0 if the rates already agree, attitudes are missing (constant), the vehicle
        hardly turns, or the recording is too short.
    """
    if len(stamps_ns) < _MIN_STEPS or not np.ptp(attitude_rad, axis=0).any():
        return 0
    seconds = (stamps_ns - stamps_ns[0]) / NS_PER_S
    period = float(np.median(np.diff(seconds)))
    rows = np.arange(0, len(seconds), max(1, round(_STEP_S / period)))
    start, stop = seconds[rows[:-1]], seconds[rows[1:]]
    R = Rotation.from_euler("ZYX", attitude_rad[rows, ::-1])
    rotations = (R[:-1].inv() * R[1:]).as_rotvec()
    # linear interpolation is off by an eighth of the squared period times the second derivative: too much in slow rows
    angle = make_interp_spline(seconds, gyro_rad_s, k=3 if period > SLOW_ROWS_S else 1).antiderivative()
    errors = np.array([rotations - angle(stop + lag) + angle(start + lag) for lag in _GRID_S])
    complete = (stop - start < 1.5 * np.median(stop - start)) & (stop + _GRID_S[-1] <= seconds[-1])
    return _best_lag_ns(errors[:, complete], rotations[complete])


def _best_lag_ns(errors: Array, rotations: Array) -> int:
    """Return the lag of least ``errors`` ``(grid, S, 3)`` of ``rotations`` ``(S, 3)``; 0 if none is clearly best."""
    if len(rotations) < _MIN_STEPS:
        return 0
    # the median over steps is the gyroscope's bias
    squared = ((errors - np.median(errors, axis=1, keepdims=True)) ** 2).sum(axis=-1)
    least = squared.min(axis=0)
    steady = least <= _MAX_ERROR_RATIO * np.median(least)  # no lag explains a jump of the attitude
    cost = squared[:, steady].mean(axis=1)
    motion = ((rotations - np.median(rotations, axis=0))[steady] ** 2).sum(axis=-1).mean()
    k = int(cost.argmin())
    clear = cost[k] < min(_MAX_ERROR_SHARE * cost[0], _MAX_UNEXPLAINED * motion)
    if motion < _MIN_ROTATION_RAD**2 or not clear or not 0 < k < len(cost) - 1:
        return 0
    before, here, after = cost[k - 1 : k + 2]
    vertex = (before - after) / (2 * (before - 2 * here + after))  # of the parabola through the three costs
    return round(1e3 * float(_GRID_S[k] + vertex * (_GRID_S[1] - _GRID_S[0]))) * _NS_PER_MS
