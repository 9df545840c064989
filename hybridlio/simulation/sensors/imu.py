"""The IMU: exact measurements along the path, and the errors of a real one."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from hybridlio.core.arrays import Array
from hybridlio.core.sensors import ImuNoise
from hybridlio.simulation.drive.path import SmoothPath
from hybridlio.simulation.rig import GRAVITY_WORLD_M_S2


def ideal_imu(path: SmoothPath, times_s: ArrayLike) -> tuple[Array, Array]:
    """Return angular velocity ``(N, 3)`` in rad/s and specific force ``Rᵀ(a - g)`` ``(N, 3)`` in m/s², IMU frame.

    Both are instantaneous values at times ``(N,)``, without errors. ``path`` is the IMU's.
    """
    motion = path.motion(times_s)
    force_world = motion.acceleration_m_s2 - GRAVITY_WORLD_M_S2
    force = np.einsum("nji,nj->ni", motion.poses[:, :3, :3], force_world)
    return motion.angular_velocity_rad_s, force


def add_noise(
    gyro_rad_s: Array, accel_m_s2: Array, noise: ImuNoise, rate_hz: float, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Add a constant bias, a random-walk bias and white noise to samples ``(N, 3)``.

    White noise of density ``d`` has the standard deviation ``d·√rate`` in samples at ``rate``; a bias walk of density
    ``w`` has steps of ``w/√rate``.
    """
    # bias, bias walk, white noise
    gyro_noise = (noise.gyro_bias_sigma_rad_s, noise.gyro_walk_rad_s2_sqrt_hz, noise.gyro_rad_s_sqrt_hz)
    accel_noise = (noise.accel_bias_sigma_m_s2, noise.accel_walk_m_s3_sqrt_hz, noise.accel_m_s2_sqrt_hz)
    gyro = gyro_rad_s + _error(len(gyro_rad_s), *gyro_noise, rate_hz, rng)
    accel = accel_m_s2 + _error(len(accel_m_s2), *accel_noise, rate_hz, rng)
    return gyro, accel


def _error(
    count: int, bias_sigma: float, walk_density: float, white_density: float, rate_hz: float, rng: np.random.Generator
) -> Array:
    """Draw the error ``(count, 3)`` of one sensor."""
    constant = bias_sigma * rng.standard_normal(3)
    walk = np.cumsum(walk_density / np.sqrt(rate_hz) * rng.standard_normal((count, 3)), axis=0)
    white = white_density * np.sqrt(rate_hz) * rng.standard_normal((count, 3))
    return np.asarray(constant + walk + white)
