"""The incremental backend: start, long straight roads, agreement with smoothing, and missing measurements."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import X
from online_runs import pose_error, run
from scipy.spatial.transform import Rotation

import hybridlio.graph.run.isam_backend as online
from hybridlio.core import se3
from hybridlio.core.errors import GraphError
from hybridlio.core.estimates import RelativePose, State
from hybridlio.core.sensors import Calibration, Frame, ImuNoise, ImuSamples, Scan
from hybridlio.core.start_state import start_state
from hybridlio.graph.run import factors
from hybridlio.graph.run.inertial_initial_pose import Preintegration
from hybridlio.graph.run.inertial_steps import InertialSteps
from hybridlio.graph.run.isam_backend import IncrementalBackend
from hybridlio.graph.run.scan_numbers import ScanNumbers
from hybridlio.graph.run.smooth import smooth
from hybridlio.simulation.drive.path import SmoothPath

STRAIGHT = RelativePose(
    se3.make(np.eye(3), [1.0, 0.0, 0.0]), np.diag(np.r_[np.full(3, 1e-3), np.full(3, 0.02)] ** 2), "straight"
)
FAILED = RelativePose(se3.exp(np.array([0.2, -0.3, 0.5, 5.0, -3.0, 2.0])), 1e-6 * np.eye(6), "broken", ok=False)


def sigmas_off(error: np.ndarray, covariance: np.ndarray) -> float:
    return float(np.sqrt(error @ np.linalg.solve(covariance, error) / len(error)))


# --------------------------------------------------------------------------------------------------- start-up


@pytest.mark.parametrize("speed", [0.0, 15.0, 30.0])
def test_the_unknown_speed_is_found_within_a_few_steps(chain: Callable[..., Any], speed: float):
    drive = chain(7, steps=5, speed=speed)
    state = run(drive)[1][-1]
    error = state.velocity_m_s - drive.velocities[5]
    assert sigmas_off(error, state.covariance[6:9, 6:9]) < 2.5
    assert np.linalg.norm(error) < 0.4  # a registration error of 2 cm in 0.1 s is 0.2 m/s


def test_the_gyroscopes_bias_converges(chain: Callable[..., Any]):
    drive = chain(8, steps=100)
    states = run(drive)[1]
    off = [np.linalg.norm(s.gyro_bias_rad_s - b) for s, b in zip(states, drive.gyro_biases[1:], strict=True)]
    assert np.linalg.norm(drive.gyro_biases[0]) > 5e-3
    assert np.mean(off[-20:]) < 0.2 * np.linalg.norm(drive.gyro_biases[0])
    sigma = np.sqrt([np.trace(s.covariance[12:, 12:]) for s in states])
    assert sigma[-1] < 0.15 * sigma[0]


def test_gravity_is_found_when_the_drive_begins_in_a_hard_bend(chain: Callable[..., Any]):
    """The mean specific force there is 0.25 rad off vertical."""
    times = np.arange(-0.5, 8.0, 0.05)
    yaw = 0.25 * times
    position = 40.0 * np.column_stack([np.sin(yaw), 1 - np.cos(yaw), np.zeros(len(times))])  # 10 m/s, 2.5 m/s²
    bend = SmoothPath.through(times, se3.make(Rotation.from_euler("z", yaw[:, None]).as_matrix(), position))
    drive = chain(9, steps=60, path=bend)
    down = drive.gravity / np.linalg.norm(drive.gravity)

    def tilt_deg(gravity: np.ndarray) -> float:
        return float(np.degrees(np.arccos(gravity @ down / np.linalg.norm(gravity))))

    assert tilt_deg(drive.start.gravity_m_s2) > 10
    state = run(drive)[1][-1]
    assert tilt_deg(state.gravity_m_s2) < 1.5
    assert sigmas_off(state.accel_bias_m_s2 - drive.accel_biases[-1], state.covariance[9:12, 9:12]) < 2


# -------------------------------------------------------------------------------------------- long, straight, constant


def straight_frame(k: int) -> Frame:
    stamps = 10**17 + (k - 1) * 10**8 + np.arange(11) * 10**7
    samples = ImuSamples(stamps, np.zeros((11, 3)), np.tile([0.0, 0.0, 9.81], (11, 1)))
    return Frame(k, Scan(10**17 + k * 10**8, np.empty((0, 3), np.float32)), samples, calibration=Calibration())


def test_a_straight_road_of_five_thousand_poses_is_solved():
    solver, spread = online.incremental_solver(), []
    start = start_state(10**17, ImuSamples.empty(), ImuNoise())
    solver.update(*factors.start_factors(start))
    for k in range(5000):
        values = gtsam.Values()
        factors.insert_state(values, k + 1, replace(start, T_world_imu=se3.make(np.eye(3), [k + 1.0, 0.0, 0.0])))
        solver.update(factors.step_factors(k, start, STRAIGHT, None, 0, np.eye(4), ScanNumbers(0)), values)
        if k % 500 == 499:
            spread.append(np.sqrt(np.diag(solver.marginalCovariance(X(k + 1)))))
    end = solver.calculateEstimatePose3(X(5000)).matrix()
    np.testing.assert_allclose(end, se3.make(np.eye(3), [5000.0, 0.0, 0.0]), atol=1e-6)
    assert (np.diff(spread, axis=0) > 0).all()
    # along the road the variances of the steps add up; across it those of the rotations, times the remaining distance
    np.testing.assert_allclose(spread[-1][3], 0.02 * np.sqrt(5000), rtol=1e-3)
    np.testing.assert_allclose(spread[-1][4], 1e-3 * np.sqrt(5000**3 / 3), rtol=1e-2)


def test_a_straight_road_of_a_thousand_poses_with_imu_is_solved_without_updating_old_poses(
    monkeypatch: pytest.MonkeyPatch,
):
    eliminated: list[int] = []
    solver = online.incremental_solver

    class Counting:
        def __init__(self, *settings: Any) -> None:
            self._solver = solver(*settings)

        def update(self, *arguments: Any) -> None:
            eliminated.append(self._solver.update(*arguments).getVariablesReeliminated())

        def __getattr__(self, name: str) -> Any:
            return getattr(self._solver, name)

    monkeypatch.setattr(online, "incremental_solver", Counting)
    backend = IncrementalBackend(InertialSteps(Calibration(), ImuNoise()))
    backend.start(start_state(10**17, straight_frame(1).imu, ImuNoise()))
    for k in range(1, 1001):
        end = backend.update(straight_frame(k), STRAIGHT)
    np.testing.assert_allclose(end.T_world_imu, se3.make(np.eye(3), [1000.0, 0.0, 0.0]), atol=0.01)
    np.testing.assert_allclose(end.velocity_m_s, [10.0, 0.0, 0.0], atol=1e-3)
    # a scan has four variables: only those of the last few scans are eliminated again
    assert np.median(eliminated[-200:]) == np.median(eliminated[100:300])
    assert max(eliminated[100:]) < 60


# --------------------------------------------------------------------------------------------------- against smoothing


def test_incremental_and_smoothed_estimates_of_the_newest_pose_agree(chain: Callable[..., Any]):
    drive = chain(11, steps=60)
    _, states, _ = run(drive)
    T = drive.calibration.T_imu_lidar
    lidar = [np.eye(4), *(se3.inverse(T) @ s.T_world_imu @ T for s in states)]
    batch = smooth(drive.record(np.array(lidar)))
    off = se3.log(se3.between(lidar[-1], batch.trajectory.poses[-1]))
    covariance = se3.rotate_covariance(states[-1].covariance[:6, :6], se3.inverse(T))
    assert sigmas_off(off, covariance) < 0.05
    assert batch.trajectory.covariances is not None
    np.testing.assert_allclose(
        np.sqrt(np.diag(batch.trajectory.covariances[-1])), np.sqrt(np.diag(covariance)), rtol=0.05
    )
    np.testing.assert_allclose(batch.velocities_m_s[-1], states[-1].velocity_m_s, atol=0.02)


# ------------------------------------------------------------------------------------ missing and repeated information


def warmed_up(chain: Callable[..., Any], steps: int = 30) -> tuple[Any, IncrementalBackend, State]:
    drive = chain(12, steps=steps + 1)
    backend = IncrementalBackend(InertialSteps(drive.calibration, drive.noise))
    backend.start(drive.start)
    for frame, relative in zip(drive.frames[1:-1], drive.relative[:-1], strict=True):
        state = backend.update(frame, relative)
    return drive, backend, state


def test_a_relative_pose_made_from_the_imu_does_not_change_the_imus_estimate(chain: Callable[..., Any]):
    drive, backend, before = warmed_up(chain)
    predicted = Preintegration(InertialSteps(drive.calibration, drive.noise)).predict(drive.frames[-1], before)
    backend.update(drive.frames[-1], predicted)
    step = backend.last_step()
    assert sigmas_off(se3.log(se3.between(predicted.pose, step.pose)), predicted.covariance) < 0.02
    np.testing.assert_allclose(np.diag(step.covariance), np.diag(predicted.covariance), rtol=0.1)


def test_the_same_relative_pose_from_another_sensor_reduces_the_uncertainty(chain: Callable[..., Any]):
    drive, backend, before = warmed_up(chain)
    predicted = Preintegration(InertialSteps(drive.calibration, drive.noise)).predict(drive.frames[-1], before)
    backend.update(drive.frames[-1], replace(predicted, from_imu=False))
    assert (np.diag(backend.last_step().covariance) < 0.7 * np.diag(predicted.covariance)).all()


def test_a_failed_relative_pose_is_bridged_by_the_imu(chain: Callable[..., Any]):
    drive, backend, _ = warmed_up(chain)
    state = backend.update(drive.frames[-1], FAILED)
    assert sigmas_off(pose_error(state, drive.poses[-1]), state.covariance[:6, :6]) < 2.5
    assert np.linalg.norm(pose_error(state, drive.poses[-1])[3:]) < 0.5


def test_two_seconds_of_failed_relative_poses_are_bridged_and_their_uncertainty_grows(chain: Callable[..., Any]):
    drive = chain(13, steps=60)
    for k in range(30, 50):
        drive.relative[k] = FAILED
    _, states, _ = run(drive)
    spread = [np.trace(s.covariance[3:6, 3:6]) for s in states]
    assert (np.diff(spread[30:50]) > 0).all()
    for k in (40, 49, 59):
        assert sigmas_off(pose_error(states[k], drive.poses[k + 1]), states[k].covariance[:6, :6]) < 2.5


@pytest.mark.parametrize("cut", ["all", "the end", "the beginning"])
def test_missing_samples_are_bridged_by_the_relative_poses(chain: Callable[..., Any], cut: str):
    drive = chain(14, steps=60)
    for k in range(31, 35):
        imu = drive.frames[k].imu
        keep = {"all": slice(0), "the end": slice(0, 5), "the beginning": slice(5, None)}[cut]
        rest = ImuSamples(imu.stamps_ns[keep], imu.gyro_rad_s[keep], imu.accel_m_s2[keep])
        drive.frames[k] = replace(drive.frames[k], imu=rest)
    _, states, _ = run(drive)
    for k in (33, 40, 59):
        state = states[k]
        assert sigmas_off(pose_error(state, drive.poses[k + 1]), state.covariance[:6, :6]) < 2.5
        assert sigmas_off(state.velocity_m_s - drive.velocities[k + 1], state.covariance[6:9, 6:9]) < 2.5


def test_without_imu_the_poses_are_the_composed_relative_poses(chain: Callable[..., Any]):
    drive = chain(15, steps=30)
    frames = [replace(frame, imu=ImuSamples.empty()) for frame in drive.frames]
    start = start_state(frames[0].scan.stamp_ns, ImuSamples.empty(), drive.noise)
    backend, states, _ = run(replace(drive, frames=frames, start=start))
    T, pose = drive.calibration.T_imu_lidar, np.eye(4)
    for relative in drive.relative:
        pose = pose @ relative.pose
    np.testing.assert_allclose(states[-1].T_world_imu, T @ pose @ se3.inverse(T), atol=1e-6)
    assert not states[-1].has_imu
    step = backend.last_step()
    np.testing.assert_allclose(step.pose, drive.relative[-1].pose, atol=1e-6)
    np.testing.assert_allclose(step.covariance, drive.relative[-1].covariance, rtol=1e-3, atol=1e-9)


def test_a_second_start_resets_the_graph(chain: Callable[..., Any]):
    drive = chain(16, steps=25)
    backend, states, _ = run(drive)
    backend.start(drive.start)
    again = [backend.update(f, r) for f, r in zip(drive.frames[1:], drive.relative, strict=True)]
    np.testing.assert_array_equal(again[-1].T_world_imu, states[-1].T_world_imu)


def test_a_graph_that_cannot_be_solved_is_an_error_that_names_the_frame(
    chain: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
):
    drive, backend, _ = warmed_up(chain)

    def fail(*_: Any) -> None:
        raise RuntimeError("Indeterminate linear system detected while working near variable x7")

    monkeypatch.setattr(backend, "_solve", fail)
    with pytest.raises(GraphError, match=r"frame 31: the graph cannot be solved: .*x7"):
        backend.update(drive.frames[-1], drive.relative[-1])
