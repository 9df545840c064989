"""What the sensors measure on a planned drive: IMU samples and scans, with noise."""

from __future__ import annotations

import numpy as np

from hybridlio.core.arrays import Array, Index, Stamps
from hybridlio.core.lidar_models import LidarModel
from hybridlio.core.sensors import NS_PER_S, ImuSamples, Scan
from hybridlio.simulation.config import SimulationConfig
from hybridlio.simulation.kitti_writer import START_NS
from hybridlio.simulation.plan import Drive
from hybridlio.simulation.random_streams import RandomStream
from hybridlio.simulation.rig import IMU_RATE_HZ, SCAN_RATE_HZ, T_IMU_LIDAR
from hybridlio.simulation.sensors.air import look_through
from hybridlio.simulation.sensors.imu import add_noise, ideal_imu
from hybridlio.simulation.sensors.lidar import RayPattern, first_hits, measure
from hybridlio.simulation.world.rays import Hits

IMU_PER_SCAN = IMU_RATE_HZ // SCAN_RATE_HZ
LEAD_TICKS = IMU_RATE_HZ // 5  # IMU samples before the first scan's stamp and after the last: 0.2 s, more than a sweep


def scan_stamps_ns(drive: Drive) -> Stamps:
    """Return the scans' stamps ``(N,)``."""
    return START_NS + np.round(drive.scan_times_s * NS_PER_S).astype(np.int64)


def imu_ticks(drive: Drive) -> Index:
    """Return the numbers of the IMU samples; 0 is at the first scan's stamp."""
    return np.arange(-LEAD_TICKS, (len(drive.scan_times_s) - 1) * IMU_PER_SCAN + LEAD_TICKS + 1)


def imu_samples(drive: Drive, config: SimulationConfig) -> ImuSamples:
    """Simulate the IMU's samples of a drive, with errors."""
    ticks = imu_ticks(drive)
    rng = np.random.default_rng([config.own_seed, RandomStream.IMU])
    gyro, accel = add_noise(*ideal_imu(drive.path, ticks / IMU_RATE_HZ), config.imu_noise, IMU_RATE_HZ, rng)
    return ImuSamples(START_NS + ticks * (NS_PER_S // IMU_RATE_HZ), gyro, accel)


def lidar_poses(drive: Drive) -> Array:
    """Return the exact poses ``T_world_lidar`` ``(N, 4, 4)`` at the scans' stamps."""
    return drive.path.poses(drive.scan_times_s) @ T_IMU_LIDAR


def scan_at(
    drive: Drive, index: int, pattern: RayPattern, config: SimulationConfig, lidar: LidarModel | None = None
) -> Scan:
    """Simulate scan ``index`` of a drive, with noise. The result does not depend on earlier scans.

    Args:
        drive: the planned drive.
        index: of the scan.
        pattern: rays of the lidar.
        config: the drive's settings.
        lidar: replaces the lidar of ``config``.
    """
    hits = hits_at(drive, index, pattern, config, lidar)
    return measured_scan(hits, drive, index, pattern, config, lidar)


def hits_at(
    drive: Drive, index: int, pattern: RayPattern, config: SimulationConfig, lidar: LidarModel | None = None
) -> Hits:
    """Return what the rays of scan ``index`` hit, without noise; arguments are those of :func:`scan_at`."""
    stamp_s = float(drive.scan_times_s[index])
    offsets_s: Array = np.zeros(1)
    if config.motion_distortion:
        offsets_s = pattern.column_offset_ns / NS_PER_S
    poses = drive.path.poses(stamp_s + offsets_s) @ T_IMU_LIDAR
    scene = drive.world.scene_around(drive.path.poses(stamp_s)[0, :3, 3])
    hits = first_hits(scene, drive.cars, pattern, poses, stamp_s + offsets_s)
    if not drive.air.is_clear:
        rng = np.random.default_rng([config.own_seed, RandomStream.AIR, index])
        look_through(drive.air, hits, pattern, poses, stamp_s, lidar or config.lidar_model, rng)
    return hits


def measured_scan(
    hits: Hits,
    drive: Drive,
    index: int,
    pattern: RayPattern,
    config: SimulationConfig,
    lidar: LidarModel | None = None,
) -> Scan:
    """Return what the lidar reports of the hits of scan ``index``; the other arguments are those of :func:`scan_at`."""
    rng = np.random.default_rng([config.own_seed, RandomStream.SCAN, index])
    stamp_ns = START_NS + round(float(drive.scan_times_s[index]) * NS_PER_S)
    return measure(hits, pattern, lidar or config.lidar_model, stamp_ns, config.motion_distortion, rng)
