"""A vehicle's drive without a lidar: a smooth path, an IMU on it, and relative poses with known noise.

These are the inputs of a factor graph, without point clouds, for Monte Carlo tests over many drives.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Stamps
from hybridlio.core.estimates import EarlierScanPose, RelativePose, State
from hybridlio.core.motion_limits import GRAVITY_M_S2, GRAVITY_MAGNITUDE_SIGMA_M_S2
from hybridlio.core.sensors import NS_PER_S, Calibration, Frame, ImuNoise, ImuSamples, Scan
from hybridlio.core.start_state import start_state
from hybridlio.core.trajectory import Trajectory
from hybridlio.record.record import Record
from hybridlio.simulation.drive.path import SmoothPath
from hybridlio.simulation.rig import GRAVITY_WORLD_M_S2, IMU_RATE_HZ, SCAN_RATE_HZ
from hybridlio.simulation.sensors.imu import ideal_imu

START_NS = 1_700_000_000_000_000_000  # November 2023; as large as real stamps, which do not fit a float64
NOISE = ImuNoise(gyro_scale_sigma=0.0)  # the samples have noise and biases alone
STEP_SIGMAS = np.r_[np.full(3, 1e-3), np.full(3, 0.02)]  # rad, m: a relative pose of lidar odometry
# a mount with rotation and lever arm on all axes, so that an error in the use of a transform shows
T_IMU_LIDAR = se3.make(Rotation.from_euler("xyz", (1.0, -0.5, 3.0), degrees=True).as_matrix(), (0.8, -0.3, 0.9))
_STEP_S = 1 / SCAN_RATE_HZ  # between scans
_KNOT_S = 0.05  # of the path's spline, far below the periods of its motion
_PATH_MARGIN_S = 0.5  # of the path beyond the drive, away from the spline's ends


@dataclass(frozen=True, eq=False)
class ChainSettings:
    """Settings of :func:`make_chain`.

    Attributes:
        steps: number of relative poses, 0.1 s each.
        speed: in m/s at the start; 0 stands still.
        imu_noise: the IMU's noise that is claimed.
        true_noise: the IMU's real noise; by default the claimed one.
        step_sigmas: ``(6,)`` claimed standard deviations of a relative pose, rad and m.
        step_error: real standard deviations relative to the claimed ones.
        drift_share: share of a relative pose's covariance that accumulates over steps, as in registration to a map;
            None for independent errors.
        back: also give the poses relative to the scans this many before.
        imu_hz: rate of the IMU.
        T_imu_lidar: ``(4, 4)`` the mount.
    """

    steps: int = 60
    speed: float = 10.0
    imu_noise: ImuNoise = NOISE
    true_noise: ImuNoise | None = None
    step_sigmas: Array = field(default_factory=STEP_SIGMAS.copy)
    step_error: float = 1.0
    drift_share: float | None = None
    back: tuple[int, ...] = ()
    imu_hz: float = IMU_RATE_HZ
    T_imu_lidar: Array = field(default_factory=T_IMU_LIDAR.copy)


@dataclass(frozen=True, eq=False)
class Chain:
    """A drive of ``N`` scans. World is the IMU's pose at the first scan.

    Attributes:
        frames: ``N`` frames with scans of no points.
        relative: ``N-1`` relative poses between the scans.
        start: the prior state at the first scan.
        poses: ``(N, 4, 4)`` true ``T_world_imu``.
        lidar_poses: ``(N, 4, 4)`` true, in the first lidar pose.
        velocities, accel_biases, gyro_biases: ``(N, 3)`` true.
        gravity: ``(3,)`` true, in world.
        noise: the IMU's noise that is claimed.
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
        """Return a run's record with the online lidar poses ``online`` ``(N, 4, 4)``."""
        stamps = np.array([frame.scan.stamp_ns for frame in self.frames])
        imu = ImuSamples.concatenate([frame.imu for frame in self.frames[1:]])
        trajectory = Trajectory(stamps, online, np.tile(np.eye(6), (len(stamps), 1, 1)))
        steps = tuple(self.relative)
        return Record(trajectory, steps, steps, imu, (), self.start, self.calibration, self.noise)


def vehicle_path(rng: np.random.Generator, seconds: float, speed: float) -> SmoothPath:
    """Return a car's path that starts at ``speed`` m/s (0 stands still): it turns, changes speed, pitches and rolls.

    Each is a sum of four random waves. Amplitudes and periods are plausible for a car in a town.
    """
    times = np.arange(-_PATH_MARGIN_S, seconds + _PATH_MARGIN_S, _KNOT_S)

    def waves(amplitude: float, periods: tuple[float, float]) -> Array:
        period, phase = rng.uniform(*periods, 4), rng.uniform(0, 2 * np.pi, 4)
        return np.asarray(amplitude * np.sin(2 * np.pi * times[:, None] / period + phase).sum(axis=1) / 2)

    speeds = speed + waves(2.0, (6.0, 20.0)) if speed else np.zeros(len(times))
    yaw = rng.uniform(-np.pi, np.pi) + waves(0.6, (8.0, 20.0))
    angles = np.column_stack([yaw, waves(0.02, (2.0, 8.0)), waves(0.02, (2.0, 8.0))])
    R = Rotation.from_euler("ZYX", angles).as_matrix()
    position = np.cumsum(R[:, :, 0] * speeds[:, None] * _KNOT_S, axis=0)
    return SmoothPath.through(times, se3.make(R, position))


def _walk(rng: np.random.Generator, count: int, sigma: float, density: float, rate: float) -> Array:
    """Draw a bias ``(count, 3)`` that starts with ``sigma`` and walks with ``density``."""
    start = sigma * rng.standard_normal(3)
    return np.asarray(start + np.cumsum(density / np.sqrt(rate) * rng.standard_normal((count, 3)), axis=0))


def _frames(stamps: Stamps, imu: ImuSamples, calibration: Calibration, noise: ImuNoise) -> list[Frame]:
    """Return frames with scans of no points, each with the samples since the previous scan."""
    nothing = np.empty((0, 3), np.float32)
    parts = [ImuSamples.empty(), *(imu.between(int(a), int(b)) for a, b in pairwise(stamps))]
    return [
        Frame(k, Scan(int(stamp), nothing), part, calibration=calibration, imu_noise=noise)
        for k, (stamp, part) in enumerate(zip(stamps, parts, strict=True))
    ]


def _relative(lidar: Array, stamps: Stamps, settings: ChainSettings, rng: np.random.Generator) -> list[RelativePose]:
    """Draw the relative poses between lidar poses ``(N, 4, 4)``.

    With a ``drift_share``, each pose has a scatter of its own about the map, which the steps on both sides share, and
    only the drift is independent.
    """
    sigmas, error, drift_share = settings.step_sigmas, settings.step_error, settings.drift_share
    covariance = np.diag(sigmas**2)
    own, scatter = 1.0, np.zeros((len(lidar), 6))
    if drift_share is not None:
        own = drift_share
        scatter = sigmas * np.sqrt((1 - drift_share) / 2) * rng.standard_normal((len(lidar), 6))
        scatter[0] = 0.0  # the map starts with the first scan
    scattered = lidar @ se3.inverse(se3.exp(error * scatter))

    def measured(i: int, j: int) -> Array:
        noise = error * sigmas * np.sqrt(own) * rng.standard_normal(6)
        return np.asarray(se3.between(scattered[i], scattered[j]) @ se3.exp(noise))

    out = []
    for k in range(1, len(lidar)):
        near = [
            EarlierScanPose(int(stamps[k - b]), measured(k - b, k), own * covariance) for b in settings.back if b <= k
        ]
        drift = None if drift_share is None else own * covariance
        out.append(RelativePose(measured(k - 1, k), covariance, "test", drift=drift, earlier_scans=tuple(near)))
    return out


def _inertial(
    path: SmoothPath, until_s: float, rate_hz: float, noise: ImuNoise, rng: np.random.Generator
) -> tuple[ImuSamples, Array, Array, Array]:
    """Draw samples up to ``until_s``; return them, the gyroscope's and accelerometer's biases, and gravity."""
    times = np.arange(round(until_s * rate_hz) + 1) / rate_hz
    gyro, accel = ideal_imu(path, times)
    gyro_bias = _walk(rng, len(times), noise.gyro_bias_sigma_rad_s, noise.gyro_walk_rad_s2_sqrt_hz, rate_hz)
    accel_bias = _walk(rng, len(times), noise.accel_bias_sigma_m_s2, noise.accel_walk_m_s3_sqrt_hz, rate_hz)
    gyro = gyro + gyro_bias + noise.gyro_rad_s_sqrt_hz * np.sqrt(rate_hz) * rng.standard_normal(gyro.shape)
    accel = accel + accel_bias + noise.accel_m_s2_sqrt_hz * np.sqrt(rate_hz) * rng.standard_normal(accel.shape)
    # gravity's magnitude varies over the Earth, with the standard deviation that the prior assumes
    gravity = np.array([0.0, 0.0, -GRAVITY_M_S2 + GRAVITY_MAGNITUDE_SIGMA_M_S2 * rng.standard_normal()])
    R_imu = path.motion(times).poses[:, :3, :3]
    accel = accel + np.einsum("nji,j->ni", R_imu, GRAVITY_WORLD_M_S2 - gravity)
    stamps = START_NS + np.round(times * NS_PER_S).astype(np.int64)
    return ImuSamples(stamps, gyro, accel), gyro_bias, accel_bias, gravity


def make_chain(seed: int, settings: ChainSettings | None = None, path: SmoothPath | None = None) -> Chain:
    """Make a drive whose IMU and relative poses have exactly the noise that they claim, unless settings differ.

    Args:
        seed: of path, biases and noise.
        settings: of the drive; by default those of :class:`ChainSettings`.
        path: of the IMU; by default a random one.
    """
    settings = settings or ChainSettings()
    rng = np.random.default_rng(seed)
    path = path or vehicle_path(rng, settings.steps * _STEP_S + 0.2, settings.speed)
    scan_s = np.arange(settings.steps + 1) * _STEP_S
    true_noise = settings.true_noise or settings.imu_noise
    imu, gyro_bias, accel_bias, gravity = _inertial(path, scan_s[-1], settings.imu_hz, true_noise, rng)
    motion = path.motion(scan_s)
    R0 = motion.poses[0, :3, :3]
    lidar = motion.poses @ settings.T_imu_lidar
    stamps = START_NS + np.round(scan_s * NS_PER_S).astype(np.int64)
    calibration = Calibration(settings.T_imu_lidar)
    frames = _frames(stamps, imu, calibration, settings.imu_noise)
    at = np.searchsorted(imu.stamps_ns, stamps)
    return Chain(
        frames,
        _relative(lidar, stamps, settings, rng),
        start_state(int(stamps[0]), frames[1].imu, settings.imu_noise),
        se3.between(motion.poses[0], motion.poses),
        se3.between(lidar[0], lidar),
        motion.velocity_m_s @ R0,
        accel_bias[at],
        gyro_bias[at],
        gravity @ R0,
        settings.imu_noise,
        calibration,
    )
