"""The backend without a graph: composed poses and compounded covariances."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.estimates import Array, RelativePose, State
from hybridlio.core.sensors import NS_PER_S, Calibration, Frame, ImuNoise, ImuSamples, Scan
from hybridlio.core.start_state import start_state
from hybridlio.datasets.registry import open_sequence
from hybridlio.graph.run.inertial_initial_pose import Preintegration
from hybridlio.graph.run.inertial_steps import InertialSteps
from hybridlio.odometry.odometry import Odometry
from hybridlio.sources.dead_reckoning import DeadReckoning
from hybridlio.sources.gate.innovation_gate import WARM_UP_STEPS

T_IMU_LIDAR = se3.exp(np.array([0.02, -0.01, 0.03, -0.8, 0.3, 0.8]))
T_LIDAR_IMU = se3.inverse(T_IMU_LIDAR)
PERIOD_NS = NS_PER_S // 10
STEP = se3.exp(np.array([0.01, -0.005, 0.05, 1.2, 0.1, -0.02]))
ROOT = np.random.default_rng(5).normal(size=(6, 6)) * np.r_[np.full(3, 5e-4), np.full(3, 5e-3)][:, None]
COVARIANCE = ROOT @ ROOT.T + np.diag(np.r_[np.full(3, 1e-4), np.full(3, 1e-3)] ** 2)


def frame(k: int, imu: ImuSamples | None = None) -> Frame:
    scan = Scan(k * PERIOD_NS, np.zeros((1, 3), np.float32))
    return Frame(k, scan, imu if imu is not None else ImuSamples.empty())


def chained(steps: list[RelativePose], T_imu_lidar: Array = T_IMU_LIDAR) -> list[State]:
    backend = DeadReckoning(Calibration(T_imu_lidar))
    backend.start(start_state(0, ImuSamples.empty(), ImuNoise()))
    return [backend.update(frame(k + 1), step) for k, step in enumerate(steps)]


def lidar_covariance(state: State) -> Array:
    return se3.rotate_covariance(state.covariance[:6, :6], T_LIDAR_IMU)


def test_the_pose_is_the_product_of_the_relative_poses():
    draws = np.random.default_rng(1).normal(size=(50, 6)) * np.r_[np.full(3, 0.1), np.full(3, 1.0)]
    pose = np.eye(4)
    for draw, state in zip(draws, chained([RelativePose(se3.exp(d), COVARIANCE, "t") for d in draws]), strict=True):
        pose = pose @ se3.exp(draw)
        np.testing.assert_allclose(T_LIDAR_IMU @ state.T_world_imu @ T_IMU_LIDAR, pose, atol=1e-10)


def test_the_covariance_agrees_with_monte_carlo():
    count, draws = 30, 4000
    state = chained([RelativePose(STEP, COVARIANCE, "test")] * count)[-1]
    noise = np.random.default_rng(2).multivariate_normal(np.zeros(6), COVARIANCE, size=(draws, count))
    poses, velocities = np.broadcast_to(np.eye(4), (draws, 4, 4)), np.zeros((draws, 3))
    for k in range(count):
        before, poses = poses, poses @ STEP @ se3.exp(noise[:, k])
        imu_before, imu = (T_IMU_LIDAR @ x @ T_LIDAR_IMU for x in (before, poses))
        velocities = (imu - imu_before)[:, :3, 3] * NS_PER_S / PERIOD_NS
    errors = np.hstack([se3.log(se3.between(state.T_world_imu, imu)), velocities - state.velocity_m_s])
    sampled, claimed = np.cov(errors.T), state.covariance[:9, :9].copy()
    claimed[6:, 6:] -= np.eye(3) * 0.1**2  # the acceleration during a step, which the samples do not have
    root = np.linalg.cholesky(claimed)
    whitened = np.linalg.solve(root, np.linalg.solve(root, sampled).T)
    np.testing.assert_allclose(np.linalg.eigvalsh(whitened), 1.0, atol=0.25)


def test_only_drift_accumulates_while_scatter_belongs_to_the_last_scan():
    drift = 0.1 * COVARIANCE
    state = chained([RelativePose(STEP, COVARIANCE, "test", drift=drift)] * 20)[-1]
    path = chained([RelativePose(STEP, drift, "test")] * 20)[-1]
    np.testing.assert_allclose(lidar_covariance(state), lidar_covariance(path) + 0.45 * COVARIANCE, rtol=1e-6)


def test_a_failed_scan_on_a_map_does_not_widen_the_next():
    on_map = RelativePose(STEP, COVARIANCE, "test", drift=0.1 * COVARIANCE)
    failed = replace(on_map, covariance=np.eye(6), ok=False)
    states, without = chained([on_map, failed, on_map]), chained([on_map] * 3)
    assert lidar_covariance(states[1])[3, 3] > 1.0
    np.testing.assert_allclose(lidar_covariance(states[2]), lidar_covariance(without[2]))


def test_a_step_without_drift_starts_from_the_last_scans_full_covariance():
    on_map = RelativePose(STEP, COVARIANCE, "test", drift=0.1 * COVARIANCE)
    states = chained([on_map, RelativePose(STEP, COVARIANCE, "test"), on_map])
    expected = lidar_covariance(states[0])
    for added in (COVARIANCE, 0.55 * COVARIANCE):
        expected = se3.compose_covariance(expected, STEP, added)
    np.testing.assert_allclose(lidar_covariance(states[2]), expected, rtol=1e-6)


def test_the_last_step_is_the_given_relative_pose():
    backend = DeadReckoning(Calibration(T_IMU_LIDAR))
    backend.start(start_state(0, ImuSamples.empty(), ImuNoise()))
    backend.update(frame(1), RelativePose(STEP, COVARIANCE, "test", from_imu=True))
    step = backend.last_step()
    np.testing.assert_allclose(step.pose, STEP, atol=1e-15)
    np.testing.assert_array_equal(step.covariance, COVARIANCE)
    assert step.from_imu


@pytest.mark.parametrize("heading_sigma_rad", [1e-4, 0.1])
def test_a_heading_error_does_not_widen_predictions_from_the_state(heading_sigma_rad: float):
    """Heading and velocity share the error, and a prediction is relative to the heading."""
    stamps = np.arange(0, 4 * PERIOD_NS, PERIOD_NS // 10)
    still = ImuSamples(stamps, np.zeros((len(stamps), 3)), np.tile([0.0, 0.0, 9.81], (len(stamps), 1)))
    start = start_state(0, still, ImuNoise())
    start.covariance[2, 2] = heading_sigma_rad**2
    straight = RelativePose(se3.exp(np.r_[0, 0, 0, 2.0, 0, 0]), np.diag(np.r_[np.full(6, 1e-3)] ** 2), "test")
    backend = DeadReckoning(Calibration())
    backend.start(start)
    backend.update(frame(1), straight)
    state = backend.update(frame(2), straight)
    assert state.has_imu
    np.testing.assert_allclose(state.velocity_m_s, [20.0, 0, 0], atol=1e-9)
    imu = still.between(2 * PERIOD_NS, 3 * PERIOD_NS)
    predicted = Preintegration(InertialSteps(Calibration(), ImuNoise())).predict(frame(3, imu), state)
    np.testing.assert_allclose(predicted.pose[:3, 3], [2.0, 0, 0], atol=1e-6)
    assert np.sqrt(predicted.covariance[4, 4]) < 0.05


def test_right_scans_pass_the_gate_without_a_graph(tiny_drive: Path):
    sequence, odometry = open_sequence(tiny_drive), Odometry(backend="none")
    verdicts = [odometry.step(sequence[k]).gate.verdict for k in range(len(sequence))]
    assert set(verdicts[WARM_UP_STEPS + 1 :]) == {"accepted"}
