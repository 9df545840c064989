"""``states.npz``: velocity, biases and innovations over a run."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hybridlio.core.arrays import Array, Stamps
from hybridlio.core.errors import DataError
from hybridlio.core.files import UNREADABLE_NPZ, atomic_path, opened_npz
from hybridlio.odometry.estimate import Estimate

if TYPE_CHECKING:
    from hybridlio.record.record import Record
    from hybridlio.smoothing.smoothed import Smoothed


@dataclass(frozen=True, eq=False)
class States:
    """What a run estimates at each of ``N`` scans beside the pose; NaN where it is not known.

    Attributes:
        stamps_ns: ``(N,)``.
        velocities_m_s: ``(N, 3)`` of the IMU, in the trajectory's frame.
        accel_biases_m_s2, gyro_biases_rad_s: ``(N, 3)`` each, in the IMU frame.
        sigmas: ``(N, 9)`` standard deviations of the three, in this order.
        nis: ``(N,)`` normalised innovations squared, of the scans against the IMU.

    Raises:
        DataError: a shape is wrong.
    """

    stamps_ns: Stamps
    velocities_m_s: Array
    accel_biases_m_s2: Array
    gyro_biases_rad_s: Array
    sigmas: Array
    nis: Array

    def __post_init__(self) -> None:
        shapes = ((), (3,), (3,), (3,), (9,), ())
        for field, shape in zip(fields(self), shapes, strict=True):
            values = getattr(self, field.name)
            if values.shape != (len(self.stamps_ns), *shape):
                raise DataError(f"{field.name} has shape {values.shape}, expected {(len(self.stamps_ns), *shape)}")

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @classmethod
    def of_estimates(cls, estimates: Iterable[Estimate]) -> States:
        """Return the states of a run's estimates."""
        unknown = np.full(18, np.nan)
        stamps, rows, nis = [], [], []
        for estimate in estimates:
            one = estimate.inertial
            stamps.append(estimate.stamp_ns)
            nis.append(np.nan if estimate.gate.nis is None else estimate.gate.nis)
            rows.append(
                unknown
                if one is None
                else np.concatenate([one.velocity_m_s, one.accel_bias_m_s2, one.gyro_bias_rad_s, one.sigmas])
            )
        columns = np.array(rows).reshape(-1, 18)
        velocities, accel_biases, gyro_biases, sigmas = np.split(columns, [3, 6, 9], axis=1)
        stamps_ns, nis_of_each = np.array(stamps, np.int64), np.array(nis, np.float64)
        return cls(stamps_ns, velocities, accel_biases, gyro_biases, sigmas, nis_of_each)

    @classmethod
    def of_smoothed(cls, smoothed: Smoothed, record: Record) -> States | None:
        """Return the states of a smoothed run, without standard deviations; None where there is no IMU."""
        if not record.start.has_imu or not len(record.imu):
            return None
        count = len(smoothed.trajectory)
        velocities = smoothed.velocities_m_s @ record.calibration.T_imu_lidar[:3, :3]  # to the lidar's first frame
        biases = smoothed.accel_biases_m_s2, smoothed.gyro_biases_rad_s
        unknown = np.full((count, 9), np.nan)
        return cls(smoothed.trajectory.stamps_ns, velocities, *biases, unknown, np.full(count, np.nan))

    def save(self, path: Path) -> None:
        """Write the states to one ``.npz`` file of plain arrays."""
        arrays: dict[str, Any] = {field.name: getattr(self, field.name) for field in fields(self)}
        with atomic_path(path) as part, part.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)

    @classmethod
    def load(cls, path: Path) -> States:
        """Read states written by :meth:`save`.

        Raises:
            DataError: the file is missing or holds something else.
        """
        try:
            with opened_npz(path) as file:
                return cls(*(file[field.name] for field in fields(cls)))
        except UNREADABLE_NPZ as error:
            raise DataError(f"{path}: not the states of a run ({error}); run `hybridlio odometry` again") from error
