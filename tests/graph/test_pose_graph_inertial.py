"""Inertial, GPS and attitude factors of a pose graph on simulated drives of known noise."""

from __future__ import annotations

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.errors import DataError
from hybridlio.core.motion_limits import GRAVITY_M_S2
from hybridlio.core.sensors import ImuNoise, ImuSamples
from hybridlio.graph import PoseGraph

STEP_SIGMAS = np.r_[np.full(3, 1e-3), np.full(3, 0.02)]  # rad, m: noise of the simulated drive


def inertial_graph(drive, steps: bool = True) -> tuple[PoseGraph, np.ndarray, np.ndarray]:
    """Return a graph of the drive's IMU and relative poses, and true poses and velocities in a world with z up."""
    g = drive.gravity / np.linalg.norm(drive.gravity)
    tilt = np.array([[0, 0, -1.0]]).T
    axis, angle = np.cross(g, tilt[:, 0]), np.arccos(np.clip(g @ tilt[:, 0], -1, 1))
    norm = np.linalg.norm(axis)
    T_up_world = se3.make(se3.so3_exp(axis / norm * angle if norm > 0 else np.zeros(3)), np.zeros(3))
    poses, velocities = T_up_world @ drive.poses, drive.velocities @ T_up_world[:3, :3].T
    T = drive.calibration.T_imu_lidar
    graph = PoseGraph()
    graph.add_prior(0, poses[0], sigmas=1e-4)
    for k, (frame, relative) in enumerate(zip(drive.frames[1:], drive.relative, strict=True)):
        if steps:
            covariance = se3.rotate_covariance(relative.covariance, T)
            graph.add_between(k, k + 1, T @ relative.pose @ se3.inverse(T), covariance)
        else:
            graph.add_pose(k + 1)
        graph.add_imu(k, k + 1, frame.imu, drive.noise)
    return graph, poses, velocities


def errors(solution, truth: np.ndarray) -> np.ndarray:
    return np.linalg.norm(solution.poses[:, :3, 3] - truth[:, :3, 3], axis=1)


def test_inertial_factors_estimate_velocity_and_biases_and_improve_poses(chain):
    drive = chain(3, steps=60)
    graph, poses, velocities = inertial_graph(drive)
    alone = PoseGraph()
    alone.add_prior(0, poses[0], sigmas=1e-4)
    for factor in graph.factors.values():
        if factor.kind == "between":
            alone.add_between(*factor.keys, _matrix(factor.measured), factor.noise.covariance)
    solution, plain = graph.optimize(), alone.optimize()
    assert np.sqrt((errors(solution, poses) ** 2).mean()) < np.sqrt((errors(plain, poses) ** 2).mean())
    for k in (0, 30, 60):
        np.testing.assert_allclose(solution.velocity(k), velocities[k], atol=0.2)
    accel, gyro = solution.bias(30)
    np.testing.assert_allclose(gyro, drive.gyro_biases[30], atol=2e-3)
    np.testing.assert_allclose(accel, drive.accel_biases[30], atol=0.15)
    assert solution.covariance(60)[3:, 3:].trace() < plain.covariance(60)[3:, 3:].trace()
    count = sum(factor.kind == "imu" for factor in graph.factors.values())
    freedom = 6 * len(graph.factors) + 9 * count - 15 * len(graph)
    assert 0.7 < 2 * solution.error / freedom < 1.3


def _matrix(coordinates: np.ndarray) -> np.ndarray:
    from hybridlio.graph.model.coordinates import to_matrices

    return to_matrices(coordinates[None])[0]


@pytest.mark.parametrize("lever", [(0.0, 0.0, 0.0), (1.0, -0.5, 0.8)])
def test_gps_with_a_lever_arm_places_a_drive_without_prior(chain, rng, lever):
    drive = chain(5, steps=60)
    truth = se3.exp([0, 0, 2.0, 0, 0, 0]) @ se3.make(np.eye(3), [300.0, -200, 10]) @ drive.poses
    T = drive.calibration.T_imu_lidar
    graph = PoseGraph()
    graph.add_pose(0)
    for k, relative in enumerate(drive.relative):
        pose = T @ relative.pose @ se3.inverse(T)
        graph.add_between(k, k + 1, pose, se3.rotate_covariance(relative.covariance, T))
    for k in range(0, 61, 3):
        antenna = se3.transform(truth[k], np.array([lever]))[0]
        graph.add_gps(k, antenna + 0.05 * rng.standard_normal(3), 0.05, lever)
    graph.add_attitude(0, truth[0, :3, 2], [0, 0, 1], 0.01)
    solution = graph.optimize()
    assert errors(solution, truth).max() < 0.15
    turned = se3.so3_log(np.swapaxes(solution.poses[:, :3, :3], 1, 2) @ truth[:, :3, :3])
    assert np.linalg.norm(turned, axis=1).max() < 0.03


def test_gravity_levels_a_pose():
    graph = PoseGraph()
    truth = se3.exp([0.2, -0.1, 0.0, 0, 0, 0])
    graph.add_prior(0, np.eye(4), sigmas=[10, 10, 0.01, 1, 1, 1])
    graph.add_gravity(0, truth[:3, :3].T @ [0, 0, 9.81], 0.001)
    up = graph.optimize().pose(0)[:3, :3].T @ [0, 0, 1]
    np.testing.assert_allclose(up, truth[2, :3], atol=1e-5)


def test_standing_still_determines_the_biases(rng):
    noise = ImuNoise()
    gyro_bias = np.array([0.004, -0.006, 0.008])
    graph = PoseGraph()
    graph.add_prior(0, np.eye(4), sigmas=1e-3)
    for k in range(5):
        graph.add_pose(k + 1, np.eye(4))
        stamps = np.arange(101) * 10_000_000 + k * 1_000_000_000
        gyro = gyro_bias + 1e-2 * rng.standard_normal((101, 3))
        accel = np.array([0, 0, 9.81]) + 0.1 * rng.standard_normal((101, 3))
        graph.add_imu(k, k + 1, ImuSamples(stamps, gyro, accel), noise)
        graph.add_between(k, k + 1, np.eye(4), sigmas=1e-4)
    graph.add_zero_velocity(0)
    graph.add_zero_velocity(5)
    solution = graph.optimize()
    np.testing.assert_allclose(solution.bias(3)[1], gyro_bias, atol=1.5e-3)
    np.testing.assert_allclose(solution.velocity(3), np.zeros(3), atol=0.01)
    np.testing.assert_allclose(solution.pose(5), np.eye(4), atol=1e-3)


def test_a_bias_factor_replaces_the_prior_of_zero_bias(chain):
    drive = chain(7, steps=20)
    graph, _, _ = inertial_graph(drive)
    given = np.array([0.3, -0.2, 0.1])
    graph.add_bias(0, given, drive.gyro_biases[0], sigmas=[1e-3] * 3 + [1e-4] * 3)
    np.testing.assert_allclose(graph.optimize().bias(0)[0], given, atol=0.01)


def test_a_precise_velocity_factor_overrides_the_estimate(chain):
    drive = chain(9, steps=20)
    graph, _, velocities = inertial_graph(drive)
    free = graph.optimize()
    graph.add_velocity(10, velocities[10] + [1.0, 0, 0], sigmas=1e-4)
    np.testing.assert_allclose(graph.optimize().velocity(10), velocities[10] + [1.0, 0, 0], atol=1e-2)
    assert np.linalg.norm(free.velocity(10) - velocities[10]) < 0.15


def test_unobserved_biases_stay_at_zero():
    graph = PoseGraph()
    graph.add_prior(0, np.eye(4), sigmas=10)
    graph.add_pose(1, np.eye(4))
    still = np.tile([0, 0, 9.81], (2, 1))
    graph.add_imu(0, 1, ImuSamples([0, 10_000_000], np.zeros((2, 3)), still))
    graph.add_zero_velocity(0)
    accel, gyro = graph.optimize().bias(0)
    np.testing.assert_allclose(np.r_[accel, gyro], np.zeros(6), atol=1e-6)


def test_a_chain_that_samples_alone_join_is_solved_alike_in_batch_and_online():
    graph, stamps_ns = PoseGraph(), np.arange(11) * 10_000_000
    graph.add_prior(0, np.eye(4), sigmas=1e-3)
    graph.add_velocity(0, [1.0, 0, 0], sigmas=0.01)
    for k in range(5):  # a turn to the left at 1 m/s and 0.5 rad/s
        gyro, accel = np.tile([0, 0, 0.5], (11, 1)), np.tile([0, 0.5, GRAVITY_M_S2], (11, 1))
        graph.add_pose(k + 1)
        graph.add_imu(k, k + 1, ImuSamples(k * 100_000_000 + stamps_ns, gyro, accel))
    batch, online = graph.optimize(), graph.online()
    online.update()
    np.testing.assert_allclose(batch.pose(5), online.pose(5), atol=1e-6)
    np.testing.assert_allclose(batch.pose(5)[:3, 3], [np.sin(0.25) * 2, 2 - 2 * np.cos(0.25), 0], atol=1e-3)


def test_samples_that_turn_by_more_than_one_factor_describes_are_refused():
    graph = PoseGraph()
    graph.add_prior(0, np.eye(4), sigmas=(1e-3,) * 6)
    graph.add_pose(1, np.eye(4))
    stamps = np.arange(0, 2_000_000_001, 10_000_000)
    gyro, accel = np.tile([0.0, 0.0, 2.0], (len(stamps), 1)), np.tile([0.0, 0.0, 9.81], (len(stamps), 1))
    with pytest.raises(DataError, match="turn by 229°, and one factor describes 180° at most; add poses in between"):
        graph.add_imu(0, 1, ImuSamples(stamps, gyro, accel))
    graph.add_imu(0, 1, ImuSamples(stamps, 0.5 * gyro, accel))
