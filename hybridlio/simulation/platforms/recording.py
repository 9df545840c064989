"""A simulated recording of a platform: its exact path, and what its sensors measure on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Stamps
from hybridlio.core.sensors import NS_PER_S, ImuSamples, Scan
from hybridlio.core.trajectory import Trajectory
from hybridlio.simulation.drive.path import SmoothPath
from hybridlio.simulation.kitti_writer import START_NS
from hybridlio.simulation.platforms.bodies import BODIES, Body
from hybridlio.simulation.platforms.config import PlatformConfig
from hybridlio.simulation.platforms.imu_grades import IMU_GRADES
from hybridlio.simulation.platforms.lidars import SCANNERS
from hybridlio.simulation.platforms.motion import body_poses, times_of
from hybridlio.simulation.platforms.people import people_around
from hybridlio.simulation.platforms.scenes.scene import Scene
from hybridlio.simulation.platforms.scenes.table import SCENES
from hybridlio.simulation.random_streams import RandomStream
from hybridlio.simulation.sensors.imu import add_noise, ideal_imu
from hybridlio.simulation.sensors.lidar import first_hits, measure
from hybridlio.simulation.world.moving import MovingObject
from hybridlio.simulation.world.rays import Hits, RayScene

IMU_RATE_HZ = 200  # of the built-in IMUs of Livox; Ouster's run at 100 or 128
_LEAD_S = 0.3  # inertial data before the first scan and after the last: more than a sweep
_MARGIN_S = 1.0  # of the path beyond that, for the spline's ends


@dataclass(frozen=True, eq=False)
class PlatformRecording:
    """A planned recording.

    Attributes:
        config: the settings.
        scene: what stands in the world.
        path: of the IMU.
        T_imu_lidar: ``(4, 4)`` the extrinsics: any rotation, and a lever arm.
        scan_times_s: ``(N,)`` starts of the sweeps, from zero.
        rays: the scene, ready for ray casting.
        people: who walk through it.
    """

    config: PlatformConfig
    scene: Scene
    path: SmoothPath
    T_imu_lidar: Array
    scan_times_s: Array
    rays: RayScene
    people: list[MovingObject]

    @property
    def scan_stamps_ns(self) -> Stamps:
        """The scans' stamps ``(N,)``."""
        return START_NS + np.round(self.scan_times_s * NS_PER_S).astype(np.int64)

    def lidar_poses(self, times_s: Array) -> Array:
        """Return the exact poses ``T_world_lidar`` ``(M, 4, 4)`` at times ``(M,)``."""
        return self.path.poses(times_s) @ self.T_imu_lidar

    def reference(self) -> Trajectory:
        """Return the exact lidar poses at the scans' stamps, in the first one's frame."""
        return Trajectory(self.scan_stamps_ns, self.lidar_poses(self.scan_times_s)).from_first()

    def imu_samples(self) -> ImuSamples:
        """Simulate the IMU's samples, with errors."""
        lead = round(_LEAD_S * IMU_RATE_HZ)
        ticks = np.arange(-lead, round(self.scan_times_s[-1] * IMU_RATE_HZ) + lead + 1)
        rng = np.random.default_rng([self.config.own_seed, RandomStream.IMU])
        noise = IMU_GRADES[self.config.imu]
        gyro, accel = add_noise(*ideal_imu(self.path, ticks / IMU_RATE_HZ), noise, IMU_RATE_HZ, rng)
        return ImuSamples(START_NS + ticks * (NS_PER_S // IMU_RATE_HZ), gyro, accel)

    def scan(self, index: int) -> Scan:
        """Simulate scan ``index``, with noise. The result does not depend on earlier scans."""
        return self.measured(index, self.hits(index))

    def hits(self, index: int) -> Hits:
        """Return what the rays of scan ``index`` hit, without noise."""
        start_s = float(self.scan_times_s[index])
        pattern = SCANNERS[self.config.lidar].sweep(start_s)
        times = start_s + pattern.column_offset_ns / NS_PER_S
        return first_hits(self.rays, self.people, pattern, self.lidar_poses(times), times)

    def measured(self, index: int, hits: Hits) -> Scan:
        """Return what the lidar reports of the hits of scan ``index``."""
        scanner = SCANNERS[self.config.lidar]
        pattern = scanner.sweep(float(self.scan_times_s[index]))
        rng = np.random.default_rng([self.config.own_seed, RandomStream.SCAN, index])
        return measure(hits, pattern, scanner.model, int(self.scan_stamps_ns[index]), True, rng)


def plan(config: PlatformConfig) -> PlatformRecording:
    """Plan the recording that ``config`` describes; the same settings give the same recording."""
    body = BODIES[config.platform]
    length = body.speed_m_s * (config.seconds + 4 * _MARGIN_S)
    scene = SCENES[config.scene].build(np.random.default_rng([config.seed, RandomStream.SCENE]), length)
    times = times_of(config.seconds, _LEAD_S + _MARGIN_S)
    motion = np.random.default_rng([config.own_seed, RandomStream.MOTION])
    mount = body_poses(scene, body, times, config.start_moving, motion)
    T_mount_lidar, T_mount_imu = _mounts(body, np.random.default_rng([config.own_seed, RandomStream.MOUNT]))
    rate_hz = SCANNERS[config.lidar].model.rate_hz
    scans = np.arange(max(round(config.seconds * rate_hz), 2)) / rate_hz
    T_imu_lidar = se3.between(T_mount_imu, T_mount_lidar)
    path, rays = SmoothPath.through(times, mount @ T_mount_imu), scene.rays()
    people = people_around(rays, path, config.seconds, config.people, config.own_seed)
    return PlatformRecording(config, scene, path, T_imu_lidar, scans, rays, people)


def _mounts(body: Body, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return where lidar and IMU are mounted: the lidar nearly level, the IMU turned in any way and off the lidar."""
    tilt = Rotation.from_euler("xyz", rng.uniform(-3.0, 3.0, 3), degrees=True)
    turn = Rotation.from_quat(rng.standard_normal(4))  # uniform over all rotations
    lever = rng.uniform(-body.lever_m, body.lever_m, 3)
    return se3.make(tilt.as_matrix(), np.zeros(3)), se3.make(turn.as_matrix(), lever)
