"""Faults put into a recording: lost scans, a blocked lidar, an IMU that falls silent or has a large bias.

Each takes a sequence, simulated or real, and returns another that says so in its notes. Times are seconds from the
first scan.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hybridlio.core.errors import ConfigError
from hybridlio.core.sensors import NS_PER_S, ImuNoise, ImuSamples, Scan
from hybridlio.datasets.sequence import Sequence
from hybridlio.evaluation.ate_rpe import select


def drop_scans(sequence: Sequence, share: float, seed: int = 0) -> Sequence:
    """Leave out a share of the scans, chosen at random; the first stays. Inertial samples all stay.

    Raises:
        ConfigError: the share is not within 0 and 1 (1 excluded).
    """
    if not 0 <= share < 1:
        raise ConfigError(f"dropped scans: the share must be at least 0 and below 1, got {share}")
    count = round(share * (len(sequence) - 1))
    lost = np.random.default_rng([seed, 11]).choice(np.arange(1, len(sequence)), count, replace=False)
    rows = np.setdiff1d(np.arange(len(sequence)), lost)
    reference, speed = sequence.reference, sequence.forward_speed_m_s
    return replace(
        sequence,
        stamps_ns=sequence.stamps_ns[rows],
        load_scan=lambda k: sequence.load_scan(int(rows[k])),
        reference=None if reference is None else select(reference, rows),
        forward_speed_m_s=None if speed is None else speed[rows],
        notes=(*sequence.notes, f"{count} of {len(sequence)} scans are left out on purpose"),
    )


def block_sector(
    sequence: Sequence, start_s: float, end_s: float, middle_deg: float = 0.0, width_deg: float = 180.0
) -> Sequence:
    """Take the points of a sector out of every scan from ``start_s`` to before ``end_s``.

    Args:
        sequence: the recording.
        start_s, end_s: when.
        middle_deg: where the sector's middle looks: 0 ahead, 90 to the left.
        width_deg: of the sector; 180 is half of each scan.
    """
    start_ns, end_ns = _between(sequence, start_s, end_s)

    def load(k: int) -> Scan:
        scan = sequence.load_scan(k)
        return _without_sector(scan, middle_deg, width_deg) if start_ns <= scan.stamp_ns < end_ns else scan

    note = f"{width_deg:g}° of the lidar's view are blocked on purpose from {start_s:g} to {end_s:g} s"
    return replace(sequence, load_scan=load, notes=(*sequence.notes, note))


def _without_sector(scan: Scan, middle_deg: float, width_deg: float) -> Scan:
    azimuth = np.degrees(np.arctan2(scan.points[:, 1], scan.points[:, 0]))
    away = np.abs((azimuth - middle_deg + 180.0) % 360.0 - 180.0)
    keep: NDArray[np.bool_] = away > width_deg / 2
    intensity = None if scan.intensity is None else scan.intensity[keep]
    offsets = None if scan.time_offsets_ns is None else scan.time_offsets_ns[keep]
    return Scan(scan.stamp_ns, scan.points[keep], intensity, offsets)


def imu_gap(sequence: Sequence, start_s: float, end_s: float) -> Sequence:
    """Take out the inertial samples from ``start_s`` to before ``end_s``."""
    start_ns, end_ns = _between(sequence, start_s, end_s)
    imu = sequence.imu
    keep = (imu.stamps_ns < start_ns) | (imu.stamps_ns >= end_ns)
    rest = ImuSamples(imu.stamps_ns[keep], imu.gyro_rad_s[keep], imu.accel_m_s2[keep])
    note = f"inertial samples are left out on purpose from {start_s:g} to {end_s:g} s"
    return replace(sequence, imu=rest, notes=(*sequence.notes, note))


def imu_bias(sequence: Sequence, sigmas: float, seed: int = 0) -> Sequence:
    """Add to every axis of gyroscope and accelerometer a constant bias ``sigmas`` times what is assumed of it.

    What is assumed is the recording's :class:`~hybridlio.core.sensors.ImuNoise`, else the default; signs are random.
    """
    noise = sequence.imu_noise or ImuNoise()
    signs = np.random.default_rng([seed, 12]).choice([-1.0, 1.0], (2, 3))
    gyro, accel = signs * sigmas * np.array([[noise.gyro_bias_sigma_rad_s], [noise.accel_bias_sigma_m_s2]])
    imu = sequence.imu
    biased = ImuSamples(imu.stamps_ns, imu.gyro_rad_s + gyro, imu.accel_m_s2 + accel)
    note = f"the IMU's biases are raised on purpose by {sigmas:g} times what is assumed of them"
    return replace(sequence, imu=biased, notes=(*sequence.notes, note))


def _between(sequence: Sequence, start_s: float, end_s: float) -> tuple[int, int]:
    if not start_s <= end_s:
        raise ConfigError(f"faults: the time from {start_s} to {end_s} s ends before it starts")
    first = int(sequence.stamps_ns[0])
    return first + round(start_s * NS_PER_S), first + round(end_s * NS_PER_S)
