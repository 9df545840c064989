"""Smooth paths: interpolation, exact derivatives, least squares."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hybridlio.core import se3
from hybridlio.core.errors import DataError
from hybridlio.simulation.drive.path import SmoothPath

TIMES = np.linspace(0.0, 4.0, 81)


def tumbling_poses() -> np.ndarray:
    """Poses through all attitudes, including a pitch of 90 degrees."""
    position = np.column_stack([3 * np.sin(TIMES), 2 * TIMES, np.cos(1.3 * TIMES)])
    attitude = Rotation.from_euler("zyx", np.column_stack([0.9 * TIMES, 1.5 * np.sin(TIMES), 0.4 * TIMES]))
    return se3.make((attitude * Rotation.from_rotvec([0.0, np.pi / 2, 0.0])).as_matrix(), position)


def test_an_interpolated_path_passes_the_poses():
    poses = tumbling_poses()
    np.testing.assert_allclose(SmoothPath.through(TIMES, poses).poses(TIMES), poses, atol=1e-10)


def test_velocity_and_acceleration_equal_numerical_derivatives():
    path, at, h = SmoothPath.through(TIMES, tumbling_poses()), np.linspace(0.3, 3.7, 57), 1e-4
    motion = path.motion(at)
    before, after = path.poses(at - h)[:, :3, 3], path.poses(at + h)[:, :3, 3]
    np.testing.assert_allclose(motion.velocity_m_s, (after - before) / (2 * h), atol=1e-6)
    second = (after - 2 * motion.poses[:, :3, 3] + before) / h**2
    np.testing.assert_allclose(motion.acceleration_m_s2, second, atol=1e-5)


def test_angular_velocity_and_acceleration_equal_numerical_derivatives():
    path, at, h = SmoothPath.through(TIMES, tumbling_poses()), np.linspace(0.3, 3.7, 57), 1e-4
    motion = path.motion(at)
    turn = se3.so3_log(np.swapaxes(path.poses(at - h)[:, :3, :3], 1, 2) @ path.poses(at + h)[:, :3, :3])
    np.testing.assert_allclose(motion.angular_velocity_rad_s, turn / (2 * h), atol=1e-6)
    before, after = path.motion(at - h).angular_velocity_rad_s, path.motion(at + h).angular_velocity_rad_s
    np.testing.assert_allclose(motion.angular_acceleration_rad_s2, (after - before) / (2 * h), atol=1e-5)


def test_a_circle_has_constant_rate_and_centripetal_acceleration():
    rate, radius, times = 0.5, 20.0, np.linspace(0.0, 10.0, 201)
    attitude = Rotation.from_euler("z", rate * times[:, None]).as_matrix()
    position = radius * np.column_stack([np.sin(rate * times), 1 - np.cos(rate * times), 0 * times])
    motion = SmoothPath.through(times, se3.make(attitude, position)).motion(np.linspace(1, 9, 33))
    np.testing.assert_allclose(motion.angular_velocity_rad_s, np.tile([0, 0, rate], (33, 1)), atol=1e-8)
    body = np.einsum("nji,nj->ni", motion.poses[:, :3, :3], motion.acceleration_m_s2)
    np.testing.assert_allclose(body, np.tile([0, radius * rate**2, 0], (33, 1)), atol=1e-7)


def test_a_least_squares_path_averages_noise(rng: np.random.Generator):
    times, sigma = np.arange(0.0, 30.0, 0.1), 0.02
    truth = se3.make(np.eye(3), np.column_stack([8 * times, 5 * np.sin(0.3 * times), 0 * times]))
    noisy = truth.copy()
    noisy[:, :3, 3] += sigma * rng.standard_normal((len(times), 3))
    path = SmoothPath.near(times, noisy, 0.5)
    error = path.poses(times)[:, :3, 3] - truth[:, :3, 3]
    assert error.std() < 0.7 * sigma
    assert np.abs(path.motion(times).acceleration_m_s2[10:-10]).max() < 3.0


def test_a_time_outside_the_path_is_rejected():
    path = SmoothPath.through(TIMES, tumbling_poses())
    with pytest.raises(DataError, match=r"defined from 0\.000 to 4\.000 s"):
        path.poses([4.1])


def test_too_few_poses_are_rejected():
    with pytest.raises(DataError, match="at least 6 poses"):
        SmoothPath.through([0.0, 1.0], tumbling_poses()[:2])
