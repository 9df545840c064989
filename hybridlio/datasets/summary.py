"""What a recording holds, as plain values: sensors, rates, gaps, clocks, point times and extrinsics."""

from __future__ import annotations

from typing import Any

import numpy as np

from hybridlio.core.arrays import Stamps
from hybridlio.core.errors import DataError
from hybridlio.core.sensors import NS_PER_S, Scan
from hybridlio.datasets.notes import labelled
from hybridlio.datasets.points.point_format import sampled
from hybridlio.datasets.sequence import Sequence

_RANGE_QUANTILES = (0.01, 0.99)  # single points may be noise


def summarise(sequence: Sequence) -> dict[str, Any]:
    """Return what a recording holds; some of its scans are read.

    Keys are ``name``, ``lidar``, ``imu``, ``gps``, ``reference``, ``T_imu_lidar``, ``odometry`` and ``notes``. Sensors
    that a recording lacks are None.
    """
    scans = _samples(sequence)
    has_times = any(scan.time_offsets_ns is not None for scan in scans)
    imu = sequence.imu
    return {
        "name": sequence.name,
        "lidar": _stream(sequence.stamps_ns, sequence.stamps_ns) | _points(sequence, scans),
        "imu": _imu(sequence) if len(imu) else None,
        "gps": _stream(np.array([fix.stamp_ns for fix in sequence.gps]), sequence.stamps_ns) if sequence.gps else None,
        "reference": None if sequence.reference is None else {"length_m": round(sequence.reference.length_m, 3)},
        "T_imu_lidar": sequence.calibration.T_imu_lidar.tolist() if len(imu) else None,
        "odometry": {
            "initial_pose": "preintegration of the IMU" if len(imu) else "constant velocity, without an IMU",
            "motion_compensation": "by the points' times" if has_times else "none: the points have no times",
        },
        "notes": labelled(sequence.notes),
    }


def _samples(sequence: Sequence) -> list[Scan]:
    found = []
    for k in sampled(len(sequence)):
        try:
            found.append(sequence.load_scan(k))
        except DataError:
            continue  # its error comes when it is used; the others describe the recording
    return found


def _stream(stamps: Stamps, scans: Stamps) -> dict[str, Any]:
    """Return count, rate, longest gap, and start and end relative to the first and the last scan."""
    steps = np.diff(stamps) / NS_PER_S
    return {
        "count": len(stamps),
        "rate_hz": round(float(1 / np.median(steps)), 3) if len(steps) and np.median(steps) > 0 else None,
        "longest_gap_s": round(float(steps.max()), 4) if len(steps) else None,
        "starts_s": round(float(stamps[0] - scans[0]) / NS_PER_S, 4),
        "ends_s": round(float(stamps[-1] - scans[-1]) / NS_PER_S, 4),
        "duration_s": round(float(stamps[-1] - stamps[0]) / NS_PER_S, 4),
    }


def _points(sequence: Sequence, scans: list[Scan]) -> dict[str, Any]:
    ranges = np.concatenate([np.linalg.norm(scan.points, axis=1) for scan in scans]) if scans else np.empty(0)
    offsets = [scan.time_offsets_ns for scan in scans if scan.time_offsets_ns is not None]
    return {
        "model": None if sequence.lidar is None else sequence.lidar.name,
        "fields": _fields(sequence),
        "points_per_scan": int(np.median([len(scan) for scan in scans])) if scans else None,
        "ranges_m": [round(float(q), 2) for q in np.quantile(ranges, _RANGE_QUANTILES)] if len(ranges) else None,
        "has_intensity": any(scan.intensity is not None for scan in scans),
        "point_times_ms": [
            round(float(np.median([end(o) for o in offsets])) / 1e6, 2) for end in (np.min, np.max)
        ]
        if offsets
        else None,
    }  # fmt: skip


def _fields(sequence: Sequence) -> list[str] | None:
    """Return the names of the points' fields, of the first looked-at scan that can be read; None if there are none."""
    load = getattr(sequence.load_scan, "load", sequence.load_scan)  # behind a correction of the vertical angle
    columns = getattr(load, "columns", None)
    if columns is None:
        return None
    for k in sampled(len(sequence)):
        try:
            return sorted(columns(k))
        except DataError:
            continue
    return None


def _imu(sequence: Sequence) -> dict[str, Any]:
    imu = sequence.imu
    return _stream(imu.stamps_ns, sequence.stamps_ns) | {
        "median_force_m_s2": round(float(np.median(np.linalg.norm(imu.accel_m_s2, axis=1))), 3),
        "largest_rate_rad_s": round(float(np.linalg.norm(imu.gyro_rad_s, axis=1).max()), 3),
    }
