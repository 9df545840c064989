"""Inertial samples beside scans: on their clock, at true scale, and mounted as the extrinsics state."""

from __future__ import annotations

import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.core.imu_scale import ImuScale
from hybridlio.core.sensors import NS_PER_S, ImuSamples
from hybridlio.datasets.notes import Notes

_MAX_LEVER_ARM_M = 20.0  # from IMU to lidar on any vehicle; more is another unit, such as millimetres
_NO_LEVER_ARM_M = 100.0  # longer than any vehicle with both: nothing could be estimated with it
_MAX_UPSIDE_DOWN = -0.5  # cosine of the angle between the specific force and the lidar's z axis: 120°, no hill


def as_stated(imu: ImuSamples, scale: ImuScale, offset_s: float | None, notes: Notes) -> ImuSamples:
    """Return the samples at the stated scale, with their stamps moved by the stated offset of the clocks."""
    if not scale.is_identity:
        notes.found("IMU samples are corrected by the scale that calibration.yaml states")
    imu = scale.corrected(imu)
    if not offset_s:
        return imu
    notes.found(f"IMU stamps are moved by {offset_s:+.6f} s, as calibration.yaml states")
    return ImuSamples(imu.stamps_ns + round(offset_s * NS_PER_S), imu.gyro_rad_s, imu.accel_m_s2)


def note_mounting(imu: ImuSamples, T_imu_lidar: Array, notes: Notes) -> None:
    """Note extrinsics that contradict the samples: lengths in another unit, or gravity that points up.

    Raises:
        DataError: the lengths are certainly in another unit.
    """
    distance_m = float(np.linalg.norm(T_imu_lidar[:3, 3]))
    if distance_m > _NO_LEVER_ARM_M:
        raise DataError(
            f"{notes.name}: T_imu_lidar: the lidar is {distance_m:g} m from the IMU; the last column must be in metres"
        )
    if distance_m > _MAX_LEVER_ARM_M:
        notes.add(f"T_imu_lidar: the lidar is {distance_m:g} m from the IMU; the last column must be in metres")
    force = T_imu_lidar[:3, :3].T @ np.median(imu.accel_m_s2, axis=0)
    if force[2] < _MAX_UPSIDE_DOWN * np.linalg.norm(force):
        notes.add(
            "the specific force points down in the lidar's frame. If the lidar is mounted upside down, that is right; "
            "if not, check T_imu_lidar, and that the accelerometer at rest reads +9.81 on the axis that points up"
        )
