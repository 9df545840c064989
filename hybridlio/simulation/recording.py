"""A simulated drive as a recording in memory, for training data that nobody needs as files."""

from __future__ import annotations

import numpy as np

from hybridlio.core.sensors import NS_PER_S, Calibration, ImuSamples, LidarModel
from hybridlio.core.trajectory import Trajectory
from hybridlio.datasets.sequence import Sequence
from hybridlio.simulation.config import SimulationConfig
from hybridlio.simulation.kitti_writer import START_NS
from hybridlio.simulation.plan import plan
from hybridlio.simulation.rig import IMU_RATE_HZ, T_CAMERA_LIDAR, T_IMU_LIDAR
from hybridlio.simulation.sensors.imu import add_noise, ideal_imu
from hybridlio.simulation.sensors.lidar import ray_pattern
from hybridlio.simulation.simulate import scan_at

_LEAD_S = 0.2  # IMU samples before the first scan and after the last one, as in the files of `simulate`


def simulated_recording(config: SimulationConfig, lidar: LidarModel | None = None) -> Sequence:
    """Plan a drive and return it as a recording whose scans are computed when they are asked for.

    The drive is the one that :func:`hybridlio.simulation.simulate.simulate` writes, without the rounding of its files
    and without GPS fixes.

    Args:
        config: the settings.
        lidar: a sensor in place of ``config.lidar``, such as one with fewer columns.

    Raises:
        ConfigError, DataError: the pose file is missing or malformed.
    """
    model = lidar or config.lidar_model
    drive, pattern = plan(config), ray_pattern(model)
    scan_stamps = START_NS + np.round(drive.scan_times_s * NS_PER_S).astype(np.int64)
    lead = round(_LEAD_S * IMU_RATE_HZ)
    last = round(float(drive.scan_times_s[-1]) * IMU_RATE_HZ)
    ticks = np.arange(-lead, last + lead + 1)
    rng = np.random.default_rng([config.seed, 6])
    gyro, accel = add_noise(*ideal_imu(drive.path, ticks / IMU_RATE_HZ), config.imu_noise, IMU_RATE_HZ, rng)
    poses = drive.path.poses(drive.scan_times_s) @ T_IMU_LIDAR
    return Sequence(
        f"simulated-{config.seed}",
        scan_stamps,
        lambda k: scan_at(drive, k, pattern, config, model),
        ImuSamples(START_NS + ticks * (NS_PER_S // IMU_RATE_HZ), gyro, accel),
        Calibration(T_IMU_LIDAR, T_CAMERA_LIDAR),
        Trajectory(scan_stamps, poses).from_first(),
        lidar=model,
        imu_noise=config.imu_noise,
    )
