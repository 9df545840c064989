"""Faults injected into a recording: lost scans, a blocked or poorly calibrated lidar, an IMU with gaps or errors.

Each function takes a sequence, simulated or real, and returns another, with the fault in its notes. Times are seconds
from the first scan.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hybridlio.core.errors import ConfigError
from hybridlio.core.sensors import NS_PER_S, ImuNoise, ImuSamples, Scan
from hybridlio.datasets.sequence import Sequence
from hybridlio.evaluation.ate_rpe import select
from hybridlio.simulation.random_streams import RandomStream


def drop_scans(sequence: Sequence, share: float, seed: int = 0) -> Sequence:
    """Drop a share of the scans, chosen at random, but never the first. IMU samples are kept.

    Raises:
        ConfigError: the share is not in [0, 1).
    """
    if not 0 <= share < 1:
        raise ConfigError(f"dropped scans: the share must be 0 or more and below 1, got {share}")
    count = round(share * (len(sequence) - 1))
    lost = np.random.default_rng([seed, RandomStream.DROPPED_SCANS]).choice(
        np.arange(1, len(sequence)), count, replace=False
    )
    rows = np.setdiff1d(np.arange(len(sequence)), lost)
    reference, speed = sequence.reference, sequence.forward_speed_m_s
    return replace(
        sequence,
        stamps_ns=sequence.stamps_ns[rows],
        load_scan=lambda k: sequence.load_scan(int(rows[k])),
        reference=None if reference is None else select(reference, rows),
        forward_speed_m_s=None if speed is None else speed[rows],
        notes=(*sequence.notes, f"injected fault: {count} of {len(sequence)} scans dropped"),
    )


def block_sector(
    sequence: Sequence, start_s: float, end_s: float, middle_deg: float = 0.0, width_deg: float = 180.0
) -> Sequence:
    """Remove the points of a sector from every scan from ``start_s`` to ``end_s`` (exclusive).

    Args:
        sequence: the recording.
        start_s, end_s: the interval.
        middle_deg: azimuth of the sector's middle, lidar frame: 0 ahead, 90 to the left.
        width_deg: of the sector; 180 is half of each scan.

    Raises:
        ConfigError: the interval ends before it starts.
    """
    start_ns, end_ns = _between(sequence, start_s, end_s)

    def load(k: int) -> Scan:
        scan = sequence.load_scan(k)
        return _without_sector(scan, middle_deg, width_deg) if start_ns <= scan.stamp_ns < end_ns else scan

    note = f"injected fault: {width_deg:g}° of the lidar's view blocked from {start_s:g} to {end_s:g} s"
    return replace(sequence, load_scan=load, notes=(*sequence.notes, note))


def _without_sector(scan: Scan, middle_deg: float, width_deg: float) -> Scan:
    azimuth = np.degrees(np.arctan2(scan.points[:, 1], scan.points[:, 0]))
    off_middle = np.abs((azimuth - middle_deg + 180.0) % 360.0 - 180.0)
    return scan.part(off_middle > width_deg / 2)


def lidar_errors(
    sequence: Sequence, elevation_sigma_deg: float = 0.2, range_by_intensity_m: float = 0.05, seed: int = 0
) -> Sequence:
    """Give a spinning lidar the systematic errors of one that is poorly calibrated.

    Args:
        sequence: the recording; its lidar's model gives the beams.
        elevation_sigma_deg: standard deviation of the beams' constant errors of elevation.
        range_by_intensity_m: by which a range is longer for a reflectance of 1 than for one of 0.
        seed: of the beams' errors.

    Raises:
        ConfigError: the recording's lidar is unknown.
    """
    if sequence.lidar is None:
        raise ConfigError(f"{sequence.name}: errors of its beams need a known lidar; state it in calibration.yaml")
    beams = np.sort(np.radians(sequence.lidar.elevations_deg))
    rng = np.random.default_rng([seed, RandomStream.LIDAR_ERRORS])
    errors = np.radians(elevation_sigma_deg) * rng.standard_normal(len(beams))

    def load(k: int) -> Scan:
        scan = sequence.load_scan(k)
        points = scan.points.astype(np.float64)
        ranges = np.linalg.norm(points, axis=1)
        elevation = np.arcsin(points[:, 2] / np.maximum(ranges, 1e-9))
        beam = np.searchsorted((beams[1:] + beams[:-1]) / 2, elevation)
        elevation = elevation + errors[beam]
        if scan.intensity is not None:
            ranges = ranges + range_by_intensity_m * (scan.intensity - 0.5)
        azimuth = np.arctan2(points[:, 1], points[:, 0])
        flat = ranges * np.cos(elevation)
        moved = np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), ranges * np.sin(elevation)])
        return replace(scan, points=moved.astype(np.float32))

    note = f"injected fault: beams off by {elevation_sigma_deg:g}°, ranges by {range_by_intensity_m:g} m with intensity"
    return replace(sequence, load_scan=load, notes=(*sequence.notes, note))


def imu_gap(sequence: Sequence, start_s: float, end_s: float) -> Sequence:
    """Remove the IMU samples from ``start_s`` to ``end_s`` (exclusive).

    Raises:
        ConfigError: the interval ends before it starts.
    """
    start_ns, end_ns = _between(sequence, start_s, end_s)
    imu = sequence.imu
    keep = (imu.stamps_ns < start_ns) | (imu.stamps_ns >= end_ns)
    rest = ImuSamples(imu.stamps_ns[keep], imu.gyro_rad_s[keep], imu.accel_m_s2[keep])
    note = f"injected fault: no IMU samples from {start_s:g} to {end_s:g} s"
    return replace(sequence, imu=rest, notes=(*sequence.notes, note))


def imu_bias(sequence: Sequence, sigmas: float, seed: int = 0) -> Sequence:
    """Add a constant bias of ``sigmas`` standard deviations, with random sign, to every axis of the IMU.

    The standard deviations are those of the recording's :class:`~hybridlio.core.sensors.ImuNoise`, else the defaults.
    """
    noise = sequence.imu_noise or ImuNoise()
    signs = np.random.default_rng([seed, RandomStream.IMU_BIAS]).choice([-1.0, 1.0], (2, 3))
    gyro, accel = signs * sigmas * np.array([[noise.gyro_bias_sigma_rad_s], [noise.accel_bias_sigma_m_s2]])
    imu = sequence.imu
    biased = ImuSamples(imu.stamps_ns, imu.gyro_rad_s + gyro, imu.accel_m_s2 + accel)
    note = f"injected fault: IMU biases of {sigmas:g} standard deviations"
    return replace(sequence, imu=biased, notes=(*sequence.notes, note))


def imu_scale_error(
    sequence: Sequence, gyro: float = 0.015, accel: float = 0.005, cross: float = 0.01, seed: int = 0
) -> Sequence:
    """Give every axis of the IMU a wrong sensitivity, and let it pick up a part of what the other two should measure.

    The defaults are those of a consumer MEMS IMU: sensitivities wrong by their tolerance, with random sign, and up to
    half of the tolerance of 2 % across axes (data sheet of the InvenSense ICM-20948).

    Args:
        sequence: the recording.
        gyro, accel: relative errors of the sensitivities.
        cross: largest share of another axis, uniformly distributed.
        seed: of the signs and shares.
    """
    rng = np.random.default_rng([seed, RandomStream.IMU_SCALE])
    others = 1.0 - np.eye(3)
    by_gyro, by_accel = (
        np.eye(3) + np.diag(share * rng.choice([-1.0, 1.0], 3)) + rng.uniform(-cross, cross, (3, 3)) * others
        for share in (gyro, accel)
    )
    imu = sequence.imu
    wrong = ImuSamples(imu.stamps_ns, imu.gyro_rad_s @ by_gyro.T, imu.accel_m_s2 @ by_accel.T)
    note = f"injected fault: IMU scale off by {100 * gyro:g} and {100 * accel:g} %, {100 * cross:g} % between axes"
    return replace(sequence, imu=wrong, notes=(*sequence.notes, note))


def _between(sequence: Sequence, start_s: float, end_s: float) -> tuple[int, int]:
    if not start_s <= end_s:
        raise ConfigError(f"faults: the interval from {start_s} to {end_s} s ends before it starts")
    first = int(sequence.stamps_ns[0])
    return first + round(start_s * NS_PER_S), first + round(end_s * NS_PER_S)
