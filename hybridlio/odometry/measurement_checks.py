"""Checks of live measurements when they are added to a stream; errors are one line and leave the stream unchanged."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from hybridlio.core.errors import ConfigError, DataError
from hybridlio.core.geodesy import GeodeticPoint
from hybridlio.core.sensors import NS_PER_S, GpsFix, Scan
from hybridlio.odometry.imu_buffer import Values

_LATEST_NS = 2**62  # far from the limit of int64; any clock in nanoseconds since 1970 is below
_LONGEST_WAIT_S = 30.0  # of a stream: half the time for which IMU samples are kept
_LARGEST_OFFSET_NS = NS_PER_S  # of a point from its scan's stamp: no lidar turns slower than once a second


def checked_stamp(stamp_ns: object, what: str) -> int:
    """Return a stamp as a Python integer.

    Raises:
        DataError: it is no integer, or beyond the range of nanoseconds in int64.
    """
    if not isinstance(stamp_ns, int | np.integer) or isinstance(stamp_ns, bool):
        raise DataError(f"{what}: the stamp must be an integer number of nanoseconds, got {stamp_ns!r:.40}")
    if abs(int(stamp_ns)) > _LATEST_NS:
        raise DataError(f"{what}: the stamp {stamp_ns} is beyond the range of nanoseconds in int64")
    return int(stamp_ns)


def checked_vector(values: ArrayLike, stamp_ns: int, name: str) -> Values:
    """Return three finite numbers of an IMU sample.

    Raises:
        DataError: they are not.
    """
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.shape != (3,):
        raise DataError(f"IMU sample at {stamp_ns} ns: {name} must be three numbers, got {_short(values)}")
    x, y, z = array.tolist()
    if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
        raise DataError(f"IMU sample at {stamp_ns} ns: {name} is not finite: {[x, y, z]}")
    return (x, y, z)


def checked_scan(stamp_ns: object, points: ArrayLike, time_offsets_ns: ArrayLike | None) -> Scan:
    """Return a scan with copies of the arrays.

    Raises:
        DataError: an array has another shape or type, or points are over 1 s from the stamp.
    """
    stamp_ns = checked_stamp(stamp_ns, "scan")
    try:
        offsets = None if time_offsets_ns is None else np.array(time_offsets_ns)
        scan = Scan(stamp_ns, np.array(points, dtype=np.float32), time_offsets_ns=offsets)
    except (TypeError, ValueError, OverflowError):
        raise DataError(
            f"scan at {stamp_ns} ns: points must be an (N, 3) array of numbers, got {_short(points)}"
        ) from None
    if scan.time_offsets_ns is not None and len(scan):
        first, last = int(scan.time_offsets_ns.min()), int(scan.time_offsets_ns.max())
        if max(-first, last) > _LARGEST_OFFSET_NS:
            raise DataError(
                f"scan at {stamp_ns} ns: its points are {first / NS_PER_S:g} to {last / NS_PER_S:g} s from its stamp; "
                "give time_offsets_ns in nanoseconds after the stamp"
            )
    return scan


def checked_fix(
    stamp_ns: object, position_m: ArrayLike, covariance_m2: ArrayLike, origin: GeodeticPoint | None
) -> GpsFix:
    """Return a GPS fix with copies of the arrays.

    Raises:
        DataError: an array has another shape or type or is not finite, or the covariance is not positive definite.
    """
    stamp_ns = checked_stamp(stamp_ns, "GPS fix")
    try:
        return GpsFix(stamp_ns, np.array(position_m, np.float64), np.array(covariance_m2, np.float64), origin)
    except (TypeError, ValueError):
        raise DataError(f"GPS fix at {stamp_ns} ns: expected numbers, arrays (3,) and (3, 3)") from None


def _short(values: object) -> str:
    return " ".join(f"{values!r:.60}".split())


def check_wait(name: str, wait_s: float) -> None:
    """Check a time that a stream waits for measurements.

    Raises:
        ConfigError: it is not between 0 and 30 s.
    """
    if not 0 <= wait_s <= _LONGEST_WAIT_S:
        raise ConfigError(f"OdometryStream: {name} must be between 0 and {_LONGEST_WAIT_S:g} s, got {wait_s}")
