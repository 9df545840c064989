"""The inertial inputs of the networks at run time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybridlio.core.arrays import Array
from hybridlio.core.sensors import Frame, ImuSamples
from hybridlio.learned.data.imu_rows import imu_rows
from hybridlio.learned.settings import NetworkSettings


def inertial(
    samples: ImuSamples, frame: Frame, settings: NetworkSettings, step: tuple[Array, float] | None
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return IMU rows ``(S, 6)``, zeros without samples, and the velocity ``(3,)`` at the last scan, as in shards.

    Args:
        samples: between the scans, or a part of them.
        frame: the current scan's.
        settings: of the network.
        step: the last relative pose and its duration in seconds, or None at the start.
    """
    T_imu_lidar = None if frame.calibration is None else frame.calibration.T_imu_lidar
    rows = np.zeros((settings.imu_samples, 6), np.float32)
    if len(samples):
        rows = imu_rows(samples, settings.imu_samples, T_imu_lidar)
    if step is None:
        return rows, np.zeros(3, np.float32)
    pose, dt_s = step
    return rows, (pose[:3, :3].T @ pose[:3, 3] / dt_s).astype(np.float32)
