from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import X
from online_runs import composed

from hybridlio.core import se3
from hybridlio.core.errors import GraphError
from hybridlio.core.estimates import RelativePose
from hybridlio.core.sensors import ImuNoise, ImuSamples
from hybridlio.core.start_state import start_state
from hybridlio.core.trajectory import Trajectory
from hybridlio.evaluation.consistency import pose_consistency, step_errors
from hybridlio.graph.run import smooth as offline
from hybridlio.graph.run.smooth import smooth
from hybridlio.smoothing.smoothed import Smoothed

ALMOST_NONE = ImuNoise(1e-6, 1e-6, 1e-9, 1e-9, 1e-6, 1e-6)
TIGHT = np.r_[np.full(3, 1e-5), np.full(3, 1e-4)]


def errors_of(poses: np.ndarray, drive: Any) -> np.ndarray:
    return se3.log(se3.between(poses, drive.lidar_poses))


def rms(errors: np.ndarray) -> tuple[float, float]:
    """Root mean squares of rotations in rad and of positions in m."""
    squares = errors[:, :3] ** 2, errors[:, 3:] ** 2
    return float(np.sqrt(squares[0].sum(axis=1).mean())), float(np.sqrt(squares[1].sum(axis=1).mean()))


@pytest.fixture(scope="module", params=[None, 0.02], ids=["steps", "map"])
def many(request: pytest.FixtureRequest, chain: Callable[..., Any]) -> list[tuple[Any, Smoothed]]:
    drives = [chain(seed, steps=40, drift_share=request.param) for seed in range(200, 216)]
    return [(drive, smooth(drive.record(composed(drive)))) for drive in drives]


def test_measurements_without_noise_give_the_true_states(chain: Callable[..., Any]):
    drive = chain(1, steps=30, imu_noise=ALMOST_NONE, step_sigmas=TIGHT, step_error=0.0)
    smoothed = smooth(drive.record(composed(drive)))
    rotation, position = rms(errors_of(smoothed.trajectory.poses, drive))
    assert rotation < 2e-5
    assert position < 2e-4
    np.testing.assert_allclose(smoothed.velocities_m_s, drive.velocities, atol=5e-3)
    np.testing.assert_allclose(smoothed.gravity_m_s2, drive.gravity, atol=0.01)
    assert smoothed.converged


def test_a_poor_initial_estimate_leads_to_the_same_solution(chain: Callable[..., Any]):
    drive = chain(2, steps=30)
    rng, poses = np.random.default_rng(0), composed(drive)
    off = poses @ se3.exp(np.r_[np.full(3, 0.05), np.full(3, 0.5)] * rng.standard_normal((len(poses), 6)))
    off[0] = np.eye(4)
    near, far = smooth(drive.record(poses)), smooth(drive.record(off))
    assert far.error_before > 100 * near.error_before
    np.testing.assert_allclose(far.trajectory.poses, near.trajectory.poses, atol=2e-3)
    assert far.error_after == pytest.approx(near.error_after, rel=1e-2)


def test_smoothing_reduces_the_error_of_composed_relative_poses(many: list[tuple[Any, Smoothed]]):
    before = np.array([rms(errors_of(composed(drive), drive)) for drive, _ in many])
    after = np.array([rms(errors_of(smoothed.trajectory.poses, drive)) for drive, smoothed in many])
    assert (after.mean(axis=0) < 0.9 * before.mean(axis=0)).all()
    for _, smoothed in many:
        assert smoothed.error_after < smoothed.error_before
        assert smoothed.converged


def test_the_final_error_is_half_the_degrees_of_freedom(many: list[tuple[Any, Smoothed]]):
    # per step: 15 residuals of the IMU and 6 of the relative pose, less 15 unknowns, a half each
    costs = [smoothed.error_after / (len(drive.relative) * 6 / 2) for drive, smoothed in many]
    assert 0.8 < np.mean(costs) < 1.25


def test_covariances_of_smoothed_poses_are_consistent(many: list[tuple[Any, Smoothed]]):
    errors = np.concatenate([errors_of(smoothed.trajectory.poses, drive)[1:] for drive, smoothed in many])
    covariances = [s.trajectory.covariances[1:] for _, s in many if s.trajectory.covariances is not None]
    consistency = pose_consistency(errors, np.concatenate(covariances))
    # the mean over one drive has a standard deviation of 0.5: 0.13 for sixteen drives
    assert 0.75 < consistency.rotation.value < 1.3
    assert 0.75 < consistency.position.value < 1.3


def test_biases_are_estimated(many: list[tuple[Any, Smoothed]]):
    before = [np.linalg.norm(drive.gyro_biases, axis=1).mean() for drive, _ in many]
    after = [np.linalg.norm(s.gyro_biases_rad_s - drive.gyro_biases, axis=1).mean() for drive, s in many]
    assert np.mean(after) < 0.35 * np.mean(before)
    assert np.mean([np.abs(s.accel_biases_m_s2 - drive.accel_biases).mean() for drive, s in many]) < 0.15


def test_the_first_pose_is_the_origin_with_almost_no_uncertainty(many: list[tuple[Any, Smoothed]]):
    for drive, smoothed in many:
        np.testing.assert_allclose(smoothed.trajectory.poses[0], np.eye(4), atol=1e-9)
        assert smoothed.trajectory.covariances is not None
        assert np.sqrt(np.diag(smoothed.trajectory.covariances[0])).max() < 1e-5
        assert smoothed.trajectory.stamps_ns.tolist() == [frame.scan.stamp_ns for frame in drive.frames]


def test_the_repr_is_one_informative_line(many: list[tuple[Any, Smoothed]]):
    smoothed = many[0][1]
    length_m, count = smoothed.trajectory.length_m, smoothed.iterations
    errors = f"error {smoothed.error_before:.4g} -> {smoothed.error_after:.4g}"
    assert repr(smoothed) == f"Smoothed(41 poses, {length_m:.1f} m, {errors}, converged after {count} iterations)"


def test_covariances_are_positive_definite_and_grow_along_the_path(many: list[tuple[Any, Smoothed]]):
    for _, smoothed in many:
        assert smoothed.trajectory.covariances is not None
        np.linalg.cholesky(smoothed.trajectory.covariances)
        rotation = np.trace(smoothed.trajectory.covariances[:, :3, :3], axis1=1, axis2=2)
        assert rotation[-1] > rotation[1]


def test_failed_steps_are_bridged_by_the_imu(chain: Callable[..., Any]):
    drive = chain(4, steps=60)
    never_true = RelativePose(se3.exp(np.array([0.2, -0.3, 0.5, 5.0, -3.0, 2.0])), 1e-6 * np.eye(6), "broken", ok=False)
    online = composed(drive)
    for k in range(25, 35):
        drive.relative[k] = never_true
    smoothed = smooth(drive.record(online))
    rotation, position = rms(errors_of(smoothed.trajectory.poses, drive))
    assert rotation < 0.02
    assert position < 0.4


def test_a_gap_in_the_samples_is_bridged_by_the_relative_poses(chain: Callable[..., Any]):
    drive = chain(5, steps=60)
    record = drive.record(composed(drive))
    stamps = record.imu.stamps_ns
    keep = (stamps < stamps[0] + 2_000_000_000) | (stamps > stamps[0] + 4_000_000_000)
    imu = ImuSamples(stamps[keep], record.imu.gyro_rad_s[keep], record.imu.accel_m_s2[keep])
    errors = errors_of(smooth(replace(record, imu=imu)).trajectory.poses, drive)
    assert rms(errors)[1] < 1.5 * rms(errors_of(composed(drive), drive))[1] + 0.05


def test_without_imu_the_poses_are_the_composed_relative_poses(chain: Callable[..., Any]):
    drive = chain(6, steps=30)
    start = start_state(drive.frames[0].scan.stamp_ns, ImuSamples.empty(), drive.noise)
    record = replace(drive.record(composed(drive)), imu=ImuSamples.empty(), start=start)
    smoothed = smooth(record)
    np.testing.assert_allclose(smoothed.trajectory.poses, composed(drive), atol=1e-6)
    assert smoothed.trajectory.covariances is not None
    expected = np.zeros((6, 6))
    for relative in drive.relative:
        expected = se3.compose_covariance(expected, relative.pose, relative.covariance)
    np.testing.assert_allclose(np.diag(smoothed.trajectory.covariances[-1]), np.diag(expected), rtol=1e-3)


def test_progress_is_reported_for_every_pose(chain: Callable[..., Any]):
    reports: list[tuple[str, int, int]] = []
    drive = chain(7, steps=5)
    smooth(drive.record(composed(drive)), lambda *what: reports.append(what))
    assert {stage for stage, _, _ in reports} == {"optimising", "covariances"}
    assert [(done, total) for stage, done, total in reports if stage == "covariances"] == [(k, 6) for k in range(1, 7)]


def test_an_underdetermined_graph_is_an_error_that_names_a_variable(
    chain: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
):
    def only_distances(i: int, *_: Any) -> gtsam.NonlinearFactorGraph:
        graph = gtsam.NonlinearFactorGraph()
        graph.add(gtsam.RangeFactorPose3(X(i), X(i + 1), 1.0, gtsam.noiseModel.Isotropic.Sigma(1, 0.1)))
        return graph

    monkeypatch.setattr(offline.factors, "step_factors", only_distances)
    drive = chain(8, steps=5)
    start = start_state(drive.frames[0].scan.stamp_ns, ImuSamples.empty(), drive.noise)
    with pytest.raises(GraphError, match=r"covariances cannot .*x\d\)\.$"):
        smooth(replace(drive.record(composed(drive)), imu=ImuSamples.empty(), start=start))


def test_covariances_of_smoothed_steps_are_consistent(many: list[tuple[Any, Smoothed]]):
    errors, covariances = [], []
    for drive, smoothed in many:
        reference = Trajectory(smoothed.trajectory.stamps_ns, drive.lidar_poses)
        poses = smoothed.trajectory.poses
        errors.append(step_errors(se3.between(poses[:-1], poses[1:]), reference))
        covariances.append(smoothed.step_covariances)
    consistency = pose_consistency(np.concatenate(errors), np.concatenate(covariances))
    assert 0.85 < consistency.rotation.value < 1.18
    assert 0.85 < consistency.position.value < 1.18


def test_smoothed_steps_have_smaller_covariances_than_measured_ones(many: list[tuple[Any, Smoothed]]):
    for drive, smoothed in many:
        before = np.array([np.trace(step.covariance) for step in drive.relative])
        assert (np.trace(smoothed.step_covariances, axis1=1, axis2=2) < before).all()
