"""A simulated drive as a recording in memory, for training data that need no files."""

from __future__ import annotations

from hybridlio.core.lidar_models import LidarModel
from hybridlio.core.sensors import Calibration
from hybridlio.core.trajectory import Trajectory
from hybridlio.datasets.sequence import Sequence
from hybridlio.simulation.config import SimulationConfig
from hybridlio.simulation.measurements import imu_samples, lidar_poses, scan_at, scan_stamps_ns
from hybridlio.simulation.plan import Drive, plan
from hybridlio.simulation.rig import T_CAMERA_LIDAR, T_IMU_LIDAR
from hybridlio.simulation.sensors.lidar import ray_pattern


def simulated_recording(config: SimulationConfig, lidar: LidarModel | None = None) -> Sequence:
    """Plan a drive and return it as a recording whose scans are computed on access.

    The drive is the one that :func:`hybridlio.simulation.simulate.simulate` writes, without the rounding of its files
    and without GPS fixes.

    Args:
        config: the settings.
        lidar: replaces the lidar of ``config``, for example by one with fewer columns.

    Raises:
        ConfigError: there is no such pose file.
        DataError: the pose file is malformed.
    """
    return drive_recording(plan(config), config, lidar)


def drive_recording(drive: Drive, config: SimulationConfig, lidar: LidarModel | None = None) -> Sequence:
    """Return a drive that is planned already, as :func:`simulated_recording` does."""
    model = lidar or config.lidar_model
    pattern, stamps = ray_pattern(model), scan_stamps_ns(drive)
    return Sequence(
        f"simulated-{config.own_seed}",
        stamps,
        lambda k: scan_at(drive, k, pattern, config, model),
        imu_samples(drive, config),
        Calibration(T_IMU_LIDAR, T_CAMERA_LIDAR),
        Trajectory(stamps, lidar_poses(drive)).from_first(),
        lidar=model,
        imu_noise=config.imu_noise,
    )
