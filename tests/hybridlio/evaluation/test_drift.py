from pathlib import Path

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.errors import DataError
from hybridlio.core.trajectory import Trajectory, read_kitti
from hybridlio.evaluation.drift import KITTI_LENGTHS_M, kitti_drift, lengths_for


def straight(n: int, spacing_m: float = 1.0, yaw_rad_per_m: float = 0.0, scale: float = 1.0) -> Trajectory:
    steps = se3.exp(np.array([0, 0, yaw_rad_per_m * spacing_m, spacing_m * scale, 0, 0]))
    poses = [np.eye(4)]
    for _ in range(n - 1):
        poses.append(poses[-1] @ steps)
    return Trajectory(np.arange(n) * 100_000_000, np.array(poses))


@pytest.mark.parametrize("sequence", ["00", "01", "02", "03", "05"])
def test_every_segment_agrees_with_kittis_program(shared_data: Path, sequence: str) -> None:
    results = shared_data / "results" / "orbslam2_stereo"
    reference = read_kitti(shared_data / "kitti_odometry" / "poses" / f"{sequence}.txt")
    drift = kitti_drift(read_kitti(results / "data" / f"{sequence}.txt"), reference)
    theirs = np.loadtxt(results / "errors" / f"{sequence}.txt")
    assert drift.rows().shape == theirs.shape
    np.testing.assert_array_equal(drift.rows()[:, [0, 3]], theirs[:, [0, 3]])
    np.testing.assert_allclose(drift.speed_m_s, theirs[:, 4], atol=2e-6)
    np.testing.assert_allclose(drift.t_err, theirs[:, 2], atol=1e-6)
    # KITTI's files have six decimals, and angles by acos in single precision are accurate to 3e-4 rad
    np.testing.assert_allclose(drift.r_err_rad_per_m, theirs[:, 1], atol=3e-6)
    assert drift.t_rel_percent == pytest.approx(theirs[:, 2].mean() * 100, abs=1e-4)
    assert drift.r_rel_deg_per_100m == pytest.approx(np.degrees(theirs[:, 1].mean()) * 100, abs=1e-3)


def test_the_drift_of_kiss_icp_agrees_with_its_log(shared_data: Path) -> None:
    folder = shared_data / "results" / "kiss_icp_00"
    drift = kitti_drift(read_kitti(folder / "00_poses_kitti.txt"), read_kitti(folder / "00_gt_kitti.txt"))
    assert drift.t_rel_percent == pytest.approx(0.527, abs=5e-4)
    assert drift.r_rel_deg_per_100m == pytest.approx(0.2, abs=0.05)


def test_a_path_one_percent_too_long_drifts_one_percent() -> None:
    # a segment ends at the first frame beyond its length: at a spacing of 0.1 m up to 0.1 % later
    drift = kitti_drift(straight(10_000, 0.1, scale=1.01), straight(10_000, 0.1))
    assert drift.t_rel_percent == pytest.approx(1.0, rel=1e-3)
    assert drift.r_rel_deg_per_100m == pytest.approx(0.0, abs=1e-9)


def test_a_constant_rotation_rate_error_is_the_rotational_drift() -> None:
    turn_deg_per_100m = 0.5
    estimate = straight(10_000, 0.1, yaw_rad_per_m=np.radians(turn_deg_per_100m) / 100)
    drift = kitti_drift(estimate, straight(10_000, 0.1))
    assert drift.r_rel_deg_per_100m == pytest.approx(turn_deg_per_100m, rel=1e-3)


def test_drift_does_not_depend_on_where_either_trajectory_starts() -> None:
    rng = np.random.default_rng(0)
    reference, estimate = straight(400), straight(400, yaw_rad_per_m=1e-4)
    moved = [Trajectory(t.stamps_ns, se3.exp(rng.normal(size=6)) @ t.poses) for t in (estimate, reference)]
    np.testing.assert_allclose(kitti_drift(*moved).t_err, kitti_drift(estimate, reference).t_err, atol=1e-9)


def test_averages_by_length_and_by_speed_cover_every_segment() -> None:
    drift = kitti_drift(straight(400, scale=1.01), straight(400))
    assert [a.at for a in drift.by_length()] == [100, 200, 300]
    assert sum(a.count for a in drift.by_length()) == len(drift)
    assert {a.at for a in drift.by_speed()} == {8, 10}  # under 10 m/s: KITTI counts one frame more
    assert drift.by_speed()[1].t_rel_percent == pytest.approx(drift.t_rel_percent)


def test_a_path_shorter_than_every_segment_has_no_drift() -> None:
    drift = kitti_drift(straight(50), straight(50))
    assert (drift.t_rel_percent, drift.r_rel_deg_per_100m, len(drift)) == (None, None, 0)
    assert drift.by_length() == drift.by_speed() == []


def test_short_paths_get_eight_fitting_lengths_and_long_ones_kittis() -> None:
    assert lengths_for(3700) == KITTI_LENGTHS_M
    assert lengths_for(71.3) == (5, 10, 15, 20, 25, 30, 35, 40)
    assert lengths_for(16.9) == (2, 4, 6, 8, 10, 12, 14, 16)
    assert lengths_for(0.02) == ()
    for path in np.geomspace(1, 100, 30):
        assert len(lengths_for(path)) == 8
        assert lengths_for(path)[-1] < path


def test_unequal_numbers_of_poses_and_non_positive_lengths_are_an_error() -> None:
    with pytest.raises(DataError, match="400 reference poses but 399"):
        kitti_drift(straight(399), straight(400))
    with pytest.raises(DataError, match="must be positive"):
        kitti_drift(straight(400), straight(400), lengths_m=(0.0, 100.0))
