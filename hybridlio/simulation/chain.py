"""A vehicle's drive without a lidar: a smooth path, an IMU on it, and relative poses of known noise.

What a factor graph is given, without the point clouds: for Monte Carlo over many drives.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.estimates import EarlierScanPose, RelativePose, State
from hybridlio.core.motion_limits import GRAVITY_MAGNITUDE_SIGMA_M_S2
from hybridlio.core.sensors import NS_PER_S, Calibration, Frame, ImuNoise, ImuSamples, Scan
from hybridlio.core.start_state import start_state
from hybridlio.core.trajectory import Trajectory
from hybridlio.record.record import Record
from hybridlio.simulation.drive.path import SmoothPath
from hybridlio.simulation.rig import GRAVITY_WORLD_M_S2
from hybridlio.simulation.sensors.imu import ideal_imu

START_NS = 1_700_000_000_000_000_000
NOISE = ImuNoise()
STEP_SIGMAS = np.r_[np.full(3, 1e-3), np.full(3, 0.02)]  # rad, m: of a relative pose
T_IMU_LIDAR = se3.make(Rotation.from_euler("xyz", (1.0, -0.5, 3.0), degrees=True).as_matrix(), (0.8, -0.3, 0.9))


@dataclass(frozen=True, eq=False)
class Chain:
    """A drive; world is the IMU's first pose.

    Attributes:
        frames: ``N``, with scans of no points.
        relative: ``N-1`` relative poses between the scans.
        start: the prior state at the first scan.
        poses: ``(N, 4, 4)`` true, of the IMU.
        lidar_poses: ``(N, 4, 4)`` true, in the first lidar pose.
        velocities, accel_biases, gyro_biases: ``(N, 3)`` true.
        gravity: ``(3,)`` true.
        noise: what the IMU is said to be worth.
        calibration: the mount.
    """

    frames: list[Frame]
    relative: list[RelativePose]
    start: State
    poses: Array
    lidar_poses: Array
    velocities: Array
    accel_biases: Array
    gyro_biases: Array
    gravity: Array
    noise: ImuNoise
    calibration: Calibration

    def record(self, online: Array) -> Record:
        """A run's record whose online lidar poses are ``online``."""
        stamps = np.array([frame.scan.stamp_ns for frame in self.frames])
        parts = [frame.imu for frame in self.frames[1:]]
        stamps_imu, first = np.unique(np.concatenate([part.stamps_ns for part in parts]), return_index=True)
        imu = ImuSamples(
            stamps_imu,
            np.concatenate([part.gyro_rad_s for part in parts])[first],
            np.concatenate([part.accel_m_s2 for part in parts])[first],
        )
        covariances = np.tile(np.eye(6), (len(stamps), 1, 1))
        trajectory = Trajectory(stamps, online, covariances)
        steps = tuple(self.relative)
        return Record(trajectory, steps, steps, imu, (), self.start, self.calibration, self.noise)


def vehicle_path(rng: np.random.Generator, seconds: float, speed: float) -> SmoothPath:
    """A car's path that starts at ``speed``: it turns, speeds up and down, pitches and rolls."""
    times = np.arange(-0.5, seconds + 0.5, 0.05)

    def waves(amplitude: float, periods: tuple[float, float]) -> Array:
        period, phase = rng.uniform(*periods, 4), rng.uniform(0, 2 * np.pi, 4)
        return np.asarray(amplitude * np.sin(2 * np.pi * times[:, None] / period + phase).sum(axis=1) / 2)

    speeds = speed + waves(2.0, (6.0, 20.0)) if speed else np.zeros(len(times))
    yaw = rng.uniform(-np.pi, np.pi) + waves(0.6, (8.0, 20.0))
    angles = np.column_stack([yaw, waves(0.02, (2.0, 8.0)), waves(0.02, (2.0, 8.0))])
    R = Rotation.from_euler("ZYX", angles).as_matrix()
    position = np.cumsum(R[:, :, 0] * speeds[:, None] * 0.05, axis=0)
    return SmoothPath.through(times, se3.make(R, position))


def _walk(rng: np.random.Generator, count: int, sigma: float, density: float, rate: float) -> Array:
    start = sigma * rng.standard_normal(3)
    return np.asarray(start + np.cumsum(density / np.sqrt(rate) * rng.standard_normal((count, 3)), axis=0))


def _frames(stamps: NDArray[np.int64], imu: ImuSamples, calibration: Calibration, noise: ImuNoise) -> list[Frame]:
    """Frames with scans of no points, each with the samples since the one before."""
    nothing = np.empty((0, 3), np.float32)
    parts = [ImuSamples.empty(), *(imu.between(int(a), int(b)) for a, b in pairwise(stamps))]
    return [
        Frame(k, Scan(int(stamp), nothing), part, calibration=calibration, imu_noise=noise)
        for k, (stamp, part) in enumerate(zip(stamps, parts, strict=True))
    ]


def _relative(
    lidar: Array,
    stamps: NDArray[np.int64],
    sigmas: Array,
    error: float,
    drift_share: float | None,
    back: tuple[int, ...],
    rng: np.random.Generator,
) -> list[RelativePose]:
    """Steps between lidar poses, each with an error of its own, or those of a path beside them that only drifts.

    ``back`` adds poses relative to the scans so far before; beside the path if there is one.
    """
    covariance = np.diag(sigmas**2)
    own, scatter = 1.0, np.zeros((len(lidar), 6))
    if drift_share is not None:
        own = drift_share
        scatter = sigmas * np.sqrt((1 - drift_share) / 2) * rng.standard_normal((len(lidar), 6))
        scatter[0] = 0.0  # the map is made of the first scan
    beside = lidar @ se3.inverse(se3.exp(error * scatter))

    def measured(i: int, j: int) -> Array:
        noise = error * sigmas * np.sqrt(own) * rng.standard_normal(6)
        return np.asarray(se3.between(beside[i], beside[j]) @ se3.exp(noise))

    out = []
    for k in range(1, len(lidar)):
        near = [EarlierScanPose(int(stamps[k - b]), measured(k - b, k), own * covariance) for b in back if b <= k]
        drift = None if drift_share is None else own * covariance
        out.append(RelativePose(measured(k - 1, k), covariance, "test", drift=drift, earlier_scans=tuple(near)))
    return out


def _inertial(
    path: SmoothPath, until_s: float, rate_hz: float, noise: ImuNoise, rng: np.random.Generator
) -> tuple[ImuSamples, Array, Array, Array]:
    """Samples up to ``until_s`` with biases and white noise; the gyroscope's and accelerometer's biases; gravity."""
    times = np.arange(round(until_s * rate_hz) + 1) / rate_hz
    gyro, accel = ideal_imu(path, times)
    gyro_bias = _walk(rng, len(times), noise.gyro_bias_sigma_rad_s, noise.gyro_walk_rad_s2_sqrt_hz, rate_hz)
    accel_bias = _walk(rng, len(times), noise.accel_bias_sigma_m_s2, noise.accel_walk_m_s3_sqrt_hz, rate_hz)
    gyro = gyro + gyro_bias + noise.gyro_rad_s_sqrt_hz * np.sqrt(rate_hz) * rng.standard_normal(gyro.shape)
    accel = accel + accel_bias + noise.accel_m_s2_sqrt_hz * np.sqrt(rate_hz) * rng.standard_normal(accel.shape)
    # gravity's magnitude differs from place to place, as the start-up's prior says
    gravity = np.array([0.0, 0.0, -9.81 + GRAVITY_MAGNITUDE_SIGMA_M_S2 * rng.standard_normal()])
    R_imu = path.motion(times).poses[:, :3, :3]
    accel = accel + np.einsum("nji,j->ni", R_imu, GRAVITY_WORLD_M_S2 - gravity)
    stamps = START_NS + np.round(times * NS_PER_S).astype(np.int64)
    return ImuSamples(stamps, gyro, accel), gyro_bias, accel_bias, gravity


def make_chain(
    seed: int,
    steps: int = 60,
    speed: float = 10.0,
    imu_noise: ImuNoise = NOISE,
    true_noise: ImuNoise | None = None,
    step_sigmas: Array = STEP_SIGMAS,
    step_error: float = 1.0,
    drift_share: float | None = None,
    back: tuple[int, ...] = (),
    imu_hz: float = 100.0,
    path: SmoothPath | None = None,
    T_imu_lidar: Array = T_IMU_LIDAR,
) -> Chain:
    """A drive of ``steps`` steps of 0.1 s whose IMU and relative poses have exactly the noise that they claim.

    Args:
        seed: of path, biases and noise.
        steps: relative poses.
        speed: metres per second at the start; 0 stands still.
        imu_noise: what the IMU is said to be.
        true_noise: what it is, where that is not the same.
        step_sigmas: of a relative pose, as claimed.
        step_error: the true error in units of the claimed one.
        drift_share: of a relative pose's covariance that adds up, where the poses are of matching to a map.
        back: also give every scan's pose relative to the scans so far before it.
        imu_hz: samples per second.
        path: of the IMU, in place of a random one.
        T_imu_lidar: the mount.
    """
    rng = np.random.default_rng(seed)
    path = path or vehicle_path(rng, steps * 0.1 + 0.2, speed)
    scan_s = np.arange(steps + 1) * 0.1
    imu, gyro_bias, accel_bias, gravity = _inertial(path, scan_s[-1], imu_hz, true_noise or imu_noise, rng)
    motion = path.motion(scan_s)
    R0 = motion.poses[0, :3, :3]
    lidar = motion.poses @ T_imu_lidar
    stamps = START_NS + np.round(scan_s * NS_PER_S).astype(np.int64)
    calibration = Calibration(T_imu_lidar)
    frames = _frames(stamps, imu, calibration, imu_noise)
    relative = _relative(lidar, stamps, step_sigmas, step_error, drift_share, back, rng)
    at = np.searchsorted(imu.stamps_ns, stamps)
    return Chain(
        frames,
        relative,
        start_state(int(stamps[0]), frames[1].imu, imu_noise),
        se3.between(motion.poses[0], motion.poses),
        se3.between(lidar[0], lidar),
        motion.velocity_m_s @ R0,
        accel_bias[at],
        gyro_bias[at],
        gravity @ R0,
        imu_noise,
        calibration,
    )
