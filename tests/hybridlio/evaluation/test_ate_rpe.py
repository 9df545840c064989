from pathlib import Path

import numpy as np
import pytest
from evo.core import metrics as evo_metrics
from evo.core.trajectory import PoseTrajectory3D

from hybridlio.core import se3
from hybridlio.core.errors import ConfigError, DataError, EstimationError
from hybridlio.core.trajectory import Trajectory, read_kitti
from hybridlio.evaluation.ate_rpe import associate, ate, rpe


def curve(n: int = 300, seed: int = 1) -> Trajectory:
    """Return a winding path with steps of 1 m at 10 Hz."""
    turns = np.cumsum(np.random.default_rng(seed).normal(0, 0.004, (n, 3)), axis=0)
    steps = se3.exp(np.hstack([turns, np.tile([1.0, 0, 0], (n, 1))]))
    poses = [np.eye(4)]
    for step in steps[:-1]:
        poses.append(poses[-1] @ step)
    return Trajectory(np.arange(n) * 100_000_000 + 1_317_384_506_000_000_000, np.array(poses))


def noisy(trajectory: Trajectory, seed: int = 2) -> Trajectory:
    noise = np.random.default_rng(seed).normal(0, [0.01] * 3 + [0.3] * 3, (len(trajectory), 6))
    offset = se3.exp([0.3, -0.2, 2.0, 10, -5, 3])
    return Trajectory(trajectory.stamps_ns, offset @ trajectory.poses @ se3.exp(noise))


def scaled(trajectory: Trajectory, scale: float) -> Trajectory:
    poses = trajectory.poses.copy()
    poses[:, :3, 3] *= scale
    return Trajectory(trajectory.stamps_ns, poses)


def for_evo(trajectory: Trajectory) -> PoseTrajectory3D:
    return PoseTrajectory3D(poses_se3=list(trajectory.poses), timestamps=trajectory.stamps_ns / 1e9)


@pytest.mark.parametrize("how", ["se3", "sim3", "first", "none"])
def test_ate_agrees_with_evo_for_every_alignment(how: str) -> None:
    reference = curve()
    estimate = scaled(noisy(reference), 1.05 if how == "sim3" else 1.0)
    ours = ate(estimate, reference, how, lever_m=0.0)
    theirs = for_evo(estimate)
    if how == "first":
        theirs.align_origin(for_evo(reference))
    elif how != "none":
        theirs.align(for_evo(reference), correct_scale=how == "sim3")
    for relation, value in (("translation_part", ours.rmse_m), ("rotation_angle_deg", ours.rmse_deg)):
        metric = evo_metrics.APE(evo_metrics.PoseRelation[relation])
        metric.process_data((for_evo(reference), theirs))
        assert value == pytest.approx(metric.get_statistic(evo_metrics.StatisticsType.rmse), rel=1e-6)


@pytest.mark.parametrize("delta", [1, 7])
def test_rpe_over_frames_agrees_with_evo(delta: int) -> None:
    reference, estimate = curve(), noisy(curve())
    ours = rpe(estimate, reference, delta)
    for relation, value in (("translation_part", ours.rmse_m), ("rotation_angle_deg", ours.rmse_deg)):
        metric = evo_metrics.RPE(evo_metrics.PoseRelation[relation], delta=delta, all_pairs=True)
        metric.process_data((for_evo(reference), for_evo(estimate)))
        assert value == pytest.approx(metric.get_statistic(evo_metrics.StatisticsType.rmse), rel=1e-6)


def test_on_a_real_drive_ate_agrees_with_evo_and_with_kiss_icps_log(shared_data: Path) -> None:
    folder = shared_data / "results" / "kiss_icp_00"
    reference, estimate = read_kitti(folder / "00_gt_kitti.txt"), read_kitti(folder / "00_poses_kitti.txt")
    theirs = for_evo(estimate)
    theirs.align(for_evo(reference))
    metric = evo_metrics.APE(evo_metrics.PoseRelation.translation_part)
    metric.process_data((for_evo(reference), theirs))
    ours = ate(estimate, reference)
    assert ours.rmse_m == pytest.approx(metric.get_statistic(evo_metrics.StatisticsType.rmse), rel=1e-6)
    theirs_rotated = evo_metrics.APE(evo_metrics.PoseRelation.rotation_angle_deg)
    theirs_rotated.process_data((for_evo(reference), theirs))
    assert ours.rmse_deg == pytest.approx(theirs_rotated.get_statistic(evo_metrics.StatisticsType.rmse), rel=1e-3)
    assert ours.rmse_m == pytest.approx(3.515, abs=1e-3)
    assert np.radians(ours.rmse_deg) == pytest.approx(0.019, abs=5e-4)


def test_rpe_agrees_between_equivalent_units() -> None:
    reference, estimate = curve(), noisy(curve())
    frames = rpe(estimate, reference, 20, "frames")
    for delta, unit in ((2.0, "seconds"), (19.9, "metres")):
        other = rpe(estimate, reference, delta, unit)
        np.testing.assert_allclose(other.translation_m, frames.translation_m)
        np.testing.assert_array_equal(other.rows, frames.rows)


def test_alignment_undoes_a_rigid_motion_and_a_scale() -> None:
    reference = curve()
    moved = Trajectory(reference.stamps_ns, se3.exp([1, 2, -0.5, 100, 50, -20]) @ reference.poses)
    assert ate(moved, reference).rmse_m < 1e-6
    assert ate(moved, reference).rmse_deg < 1e-6
    assert ate(scaled(moved, 0.9), reference, "sim3").rmse_m < 1e-6


@pytest.mark.parametrize("speed_m", [0.0, 1.0])
def test_position_noise_does_not_rotate_a_straight_path_or_one_at_rest(speed_m: float) -> None:
    poses = se3.make(np.tile(np.eye(3), (80, 1, 1)), np.outer(np.arange(80) * speed_m, [1, 0, 0]))
    reference = Trajectory(np.arange(80), poses)
    noise = np.random.default_rng(4).normal(0, [0.001] * 3 + [0.05] * 3, (80, 6))
    moved = Trajectory(np.arange(80), se3.exp([1, 2, -0.5, 10, 5, -2]) @ poses @ se3.exp(noise))
    errors = ate(moved, reference)
    assert errors.rmse_m == pytest.approx(0.05 * np.sqrt(3), rel=0.15)
    assert errors.rmse_deg < 0.3
    assert ate(moved, reference, lever_m=0.0).rmse_deg > 10


def test_association_at_equal_stamps_changes_nothing() -> None:
    reference, estimate = curve(), noisy(curve())
    both = associate(estimate, reference)
    assert both.reference is reference
    assert both.estimate is estimate


def test_the_trajectory_with_more_poses_is_interpolated_at_the_stamps_of_the_other() -> None:
    fine = curve(1001)
    a_quarter_later = se3.interpolate(fine.poses[:-4:4], fine.poses[1:-3:4], np.full(250, 0.25))
    coarse = Trajectory(fine.stamps_ns[:-4:4] + 25_000_000, a_quarter_later)
    for reference, estimate in ((fine, coarse), (coarse, fine)):
        both = associate(estimate, reference)
        assert (both.reference.stamps_ns == coarse.stamps_ns).all()
        assert (both.estimate.stamps_ns == coarse.stamps_ns).all()
        np.testing.assert_allclose(both.reference.poses, both.estimate.poses, atol=1e-9)
    assert (associate(fine, coarse).estimate_rows == np.arange(0, 1000, 4)).all()


def test_stamps_in_a_gap_of_the_reference_or_outside_it_are_dropped() -> None:
    estimate = curve(100)
    rows = np.r_[10:40, 70:90]
    reference = Trajectory(estimate.stamps_ns[rows], estimate.poses[rows])
    both = associate(estimate, reference, max_difference_ns=50_000_000)
    assert (both.estimate_rows == rows).all()
    np.testing.assert_allclose(both.reference.poses, both.estimate.poses, atol=1e-12)


def test_association_keeps_covariances_with_their_poses() -> None:
    path = curve(50)
    covariances = np.arange(1, 51)[:, None, None] * np.eye(6)
    estimate = Trajectory(path.stamps_ns, path.poses, covariances)
    both = associate(estimate, Trajectory(path.stamps_ns[5:20], path.poses[5:20]))
    np.testing.assert_array_equal(both.estimate.covariances, covariances[5:20])


def test_disjoint_time_spans_are_an_error_that_names_both() -> None:
    reference = curve()
    estimate = Trajectory(np.arange(300) * 100_000_000, reference.poses)
    with pytest.raises(DataError, match=r"from 1317384506\.000 to .* from 0\.000 to 29\.900 s; check"):
        associate(estimate, reference)
    with pytest.raises(DataError, match="the estimate has 1 pose;"):
        associate(Trajectory(reference.stamps_ns[:1], reference.poses[:1]), reference)


def test_errors_for_invalid_arguments_list_the_choices() -> None:
    reference = curve(20)
    with pytest.raises(ConfigError, match="unknown alignment 'yaw'; choose one of se3, sim3, first, none"):
        ate(reference, reference, "yaw")  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="one of frames, seconds, metres"):
        rpe(reference, reference, 1, "miles")  # type: ignore[arg-type]
    with pytest.raises(DataError, match="shorter"):
        rpe(reference, reference, 100, "metres")
    with pytest.raises(EstimationError, match="no scale"):
        ate(scaled(reference, 0.0), reference, "sim3")
