"""What an IMU on the path measures: exact, then with bias, bias walk and noise."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from hybridlio.core.arrays import Array
from hybridlio.core.sensors import ImuNoise
from hybridlio.simulation.drive.path import SmoothPath
from hybridlio.simulation.rig import GRAVITY_WORLD_M_S2


def ideal_imu(path: SmoothPath, times_s: ArrayLike) -> tuple[Array, Array]:
    """Angular velocity ``(N, 3)`` in rad/s and specific force ``R^T (a - g)`` ``(N, 3)`` in m/s² at times ``(N,)``.

    ``path`` is the IMU's own, so both are instantaneous values in the IMU frame, without noise.
    """
    motion = path.motion(times_s)
    force_world = motion.acceleration_m_s2 - GRAVITY_WORLD_M_S2
    force = np.einsum("nji,nj->ni", motion.poses[:, :3, :3], force_world)
    return motion.angular_velocity_rad_s, force


def add_noise(
    gyro_rad_s: Array, accel_m_s2: Array, noise: ImuNoise, rate_hz: float, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Samples ``(N, 3)`` with a constant bias, a random-walk bias and white noise on top.

    White noise of density ``d`` has the standard deviation ``d·sqrt(rate)`` on samples taken at ``rate``; a bias walk
    of density ``w`` grows by ``w/sqrt(rate)`` a sample.
    """
    gyro = gyro_rad_s + _error(
        len(gyro_rad_s),
        noise.gyro_bias_sigma_rad_s,
        noise.gyro_walk_rad_s2_sqrt_hz,
        noise.gyro_rad_s_sqrt_hz,
        rate_hz,
        rng,
    )
    accel = accel_m_s2 + _error(
        len(accel_m_s2),
        noise.accel_bias_sigma_m_s2,
        noise.accel_walk_m_s3_sqrt_hz,
        noise.accel_m_s2_sqrt_hz,
        rate_hz,
        rng,
    )
    return gyro, accel


def _error(
    count: int, bias_sigma: float, walk_density: float, white_density: float, rate_hz: float, rng: np.random.Generator
) -> Array:
    constant = bias_sigma * rng.standard_normal(3)
    walk = np.cumsum(walk_density / np.sqrt(rate_hz) * rng.standard_normal((count, 3)), axis=0)
    white = white_density * np.sqrt(rate_hz) * rng.standard_normal((count, 3))
    return np.asarray(constant + walk + white)
