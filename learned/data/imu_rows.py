"""Resampling of the IMU samples between two scans to a fixed number of rows, in the lidar's axes. NumPy only."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from hybridlio.core.arrays import Floats
from hybridlio.core.errors import DataError
from hybridlio.core.sensors import NS_PER_S, ImuSamples


def imu_rows(samples: ImuSamples, count: int, T_imu_lidar: ArrayLike | None = None) -> Floats:
    """Return ``(count, 6)`` float32: angular velocity (rad/s), then specific force (m/s²), evenly spaced in time.

    Samples are interpolated linearly from the first stamp to the last; a single sample is repeated. Values are rotated
    into the lidar's axes, so that trained weights do not depend on the IMU's mounting; the lever arm is ignored.

    Args:
        samples: from the last scan's stamp to the current one's, as in :class:`hybridlio.core.sensors.Frame`.
        count: S, the paper's 15.
        T_imu_lidar: ``(4, 4)``; None is the identity.

    Raises:
        DataError: ``samples`` is empty.
    """
    if not len(samples):
        raise DataError("no IMU samples between two scans; the network needs at least one")
    at = (samples.stamps_ns - samples.stamps_ns[0]) / NS_PER_S
    values = np.hstack([samples.gyro_rad_s, samples.accel_m_s2])
    wanted = np.linspace(0.0, at[-1], count)
    rows = np.column_stack([np.interp(wanted, at, column) for column in values.T])
    if T_imu_lidar is not None:
        R_imu_lidar = np.asarray(T_imu_lidar, dtype=np.float64)[:3, :3]
        rows = (rows.reshape(count, 2, 3) @ R_imu_lidar).reshape(count, 6)  # row vectors: R_lidar_imu from the left
    return rows.astype(np.float32)
