"""Rides of a body that turns and accelerates in all directions, with sensors whose calibration is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybridlio.core import se3
from hybridlio.core.motion_limits import GRAVITY_M_S2
from hybridlio.core.sensors import NS_PER_S, ImuNoise, ImuSamples
from hybridlio.graph import PoseGraph

STEP_S, SAMPLES = 0.2, 20  # time of a step between poses, and its samples of the IMU
NOISE = ImuNoise(
    accel_m_s2_sqrt_hz=5e-3, gyro_rad_s_sqrt_hz=5e-4, accel_walk_m_s3_sqrt_hz=1e-9, gyro_walk_rad_s2_sqrt_hz=1e-9,
    accel_bias_sigma_m_s2=0.05, gyro_bias_sigma_rad_s=0.005, gyro_scale_sigma=0.0,
)  # fmt: skip
STEP_SIGMAS = np.r_[np.full(3, 1e-3), np.full(3, 0.01)]
FIX_SIGMA = 0.03


@dataclass(frozen=True, eq=False)
class Truth:
    """True calibration: extrinsics, clocks of lidar and GPS, antenna, scale, biases, direction of gravity."""

    T_body_lidar: np.ndarray
    lidar_s: float
    gps_s: float
    antenna_m: np.ndarray
    scale: float
    bias: np.ndarray
    gravity: np.ndarray

    @classmethod
    def drawn(cls, rng: np.random.Generator, sigmas: dict[str, float]) -> Truth:
        """Return a calibration that differs from the stated one by as much as its priors say."""
        turn, move = sigmas["rotation"] * rng.standard_normal(3), sigmas["translation"] * rng.standard_normal(3)
        tilt = sigmas["gravity"] * rng.standard_normal(2)
        return cls(
            se3.exp(np.r_[turn, move]),
            sigmas["lidar_s"] * rng.standard_normal(),
            sigmas["gps_s"] * rng.standard_normal(),
            sigmas["antenna"] * rng.standard_normal(3),
            1 + sigmas["scale"] * rng.standard_normal(),
            np.r_[0.05 * rng.standard_normal(3), 0.005 * rng.standard_normal(3)],
            se3.so3_exp([*tilt, 0]) @ [0, 0, -1.0],
        )


class Ride:
    """A smooth path: sums of sines in position and rotation vector, differentiable at any time."""

    def __init__(self, rng: np.random.Generator, size: float = 4.0, turn: float = 0.6) -> None:
        self._waves = rng.uniform(0.5, 1.5, (6, 2)), rng.uniform(0, 6, (6, 2))
        self._sizes = np.r_[np.full(3, turn), np.full(3, size)]

    def _curve(self, t: np.ndarray, derivative: int) -> np.ndarray:
        rates, phases = self._waves
        angles = t[:, None, None] * rates + phases + derivative * np.pi / 2
        return self._sizes * (rates**derivative * np.sin(angles)).mean(axis=2)

    def poses(self, t: np.ndarray) -> np.ndarray:
        """Return poses ``(N, 4, 4)``."""
        curve = self._curve(t, 0)
        return se3.make(se3.so3_exp(curve[:, :3]), curve[:, 3:])

    def velocities(self, t: np.ndarray) -> np.ndarray:
        """Return velocities ``(N, 3)`` in world."""
        return self._curve(t, 1)[:, 3:]

    def samples(self, t: np.ndarray, truth: Truth, rng: np.random.Generator) -> ImuSamples:
        """Return noisy samples."""
        R, after = self.poses(t)[:, :3, :3], self.poses(t + 1e-5)[:, :3, :3]
        turned = np.swapaxes(R, 1, 2)
        gyro = se3.so3_log(turned @ after) / 1e-5
        force = (turned @ (self._curve(t, 2)[:, 3:] - GRAVITY_M_S2 * truth.gravity)[..., None])[..., 0]
        density = np.sqrt(SAMPLES / STEP_S)
        gyro = gyro + truth.bias[3:] + NOISE.gyro_rad_s_sqrt_hz * density * rng.standard_normal(gyro.shape)
        force = force + truth.bias[:3] + NOISE.accel_m_s2_sqrt_hz * density * rng.standard_normal(force.shape)
        return ImuSamples((t * NS_PER_S).round().astype(np.int64), gyro, force)


def calibrated_graph(rng: np.random.Generator, truth: Truth, stated: PoseGraph, steps: int) -> PoseGraph:
    """Return a graph of a ride, whose measurements depend on the calibration variables that ``stated`` has."""
    graph, ride, times = stated, Ride(rng), STEP_S * np.arange(steps + 1)
    poses, names = ride.poses(times), set(stated.calibrations)
    lidar = ride.poses(times + truth.lidar_s) @ truth.T_body_lidar
    fixed = ride.poses(times + truth.gps_s)
    antennas = (fixed[:, :3, :3] @ truth.antenna_m) + fixed[:, :3, 3]
    graph.add_prior(0, poses[0], sigmas=1e-4)
    for k in range(steps):
        step = se3.between(lidar[k], lidar[k + 1])
        step = se3.make(step[:3, :3], truth.scale * step[:3, 3]) @ se3.exp(STEP_SIGMAS * rng.standard_normal(6))
        graph.add_sensor_step(k, k + 1, step, sorted(names & {"lidar", "lidar clock", "wheels"}), sigmas=STEP_SIGMAS)
        t = np.linspace(times[k], times[k + 1], SAMPLES + 1)
        samples = ride.samples(t, truth, rng)
        graph.add_imu(k, k + 1, samples, NOISE, calibration=sorted(names & {"biases", "gravity"}))
    for k in range(steps + 1):
        fix = antennas[k] + FIX_SIGMA * rng.standard_normal(3)
        graph.add_gps(k, fix, FIX_SIGMA, calibration=sorted(names & {"antenna", "GPS clock"}))
    return graph
