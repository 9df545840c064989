"""Counts of what became of the data of a stream."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class StreamCounts:
    """What became of the data of a stream. Each scan received is in exactly one of the counts marked by *.

    Attributes:
        scans, imu, fixes: received and well-formed.
        estimates: * scans with an estimate, bridged ones included.
        waiting_scans: * waiting for IMU samples or for computing time.
        late_scans: * refused: a scan with the same or a later stamp was estimated already, or the stamp repeats.
        skipped_scans: * left out because estimation was too slow; the IMU bridges them.
        unusable_scans: * before the first estimate, with too few points to start at.
        late_imu: samples refused: they came after the estimate of the first scan behind them.
        repeated_imu: samples refused: their stamp repeats.
        late_fixes: fixes that came after the estimate of the first scan behind them; used nevertheless.
        without_imu: scans estimated although IMU samples of their interval were missing after the lag.
        repeated_points: scans whose points are those of the scan before, delivered twice; they are bridged.
    """

    scans: int = 0
    imu: int = 0
    fixes: int = 0
    estimates: int = 0
    waiting_scans: int = 0
    late_scans: int = 0
    skipped_scans: int = 0
    unusable_scans: int = 0
    late_imu: int = 0
    repeated_imu: int = 0
    late_fixes: int = 0
    without_imu: int = 0
    repeated_points: int = 0
