import numpy as np
import pytest

from hybridlio.cloud.normals import estimate_normals
from hybridlio.core import se3
from hybridlio.core.errors import ConfigError


def worst_angle_deg(normals: np.ndarray, expected: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(np.einsum("ij,ij->i", normals, expected), -1, 1))).max())


@pytest.mark.parametrize("thin_m", [0.0, 0.2])
def test_normals_of_a_plane_are_its_normal_and_face_the_sensor(rng, thin_m):
    R = se3.so3_exp([0.3, -0.5, 0.2])
    flat = np.column_stack([rng.uniform(-5, 5, (4000, 2)), np.full(4000, 3.0)])
    normals = estimate_normals(flat @ R.T, thin_m=thin_m)
    assert worst_angle_deg(normals, np.broadcast_to(-R[:, 2], normals.shape)) < 0.1


def test_normals_inside_a_cylinder_point_to_its_axis(rng):
    angle, height = rng.uniform(0, 2 * np.pi, 20_000), rng.uniform(-2, 2, 20_000)
    normals = estimate_normals(np.column_stack([10 * np.cos(angle), 10 * np.sin(angle), height]))
    inside = np.abs(height) < 1.7  # at the rim neighbours are on one side only
    assert worst_angle_deg(normals[inside], -np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])[inside]) < 2.0


def test_normals_of_a_ball_ahead_point_outwards_on_its_visible_side(rng):
    outwards = rng.normal(size=(20_000, 3))
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    centre = np.array([20.0, 5.0, 1.0])
    normals = estimate_normals(centre + 3 * outwards)
    seen = np.einsum("ij,ij->i", outwards, centre + 3 * outwards) < -1.0
    assert seen.sum() > 1000
    assert worst_angle_deg(normals[seen], outwards[seen]) < 5.0


def test_turning_the_cloud_turns_the_normals(rng):
    points = np.column_stack([rng.uniform(-10, 10, (5000, 2)), rng.normal(-2, 0.3, 5000)])
    R = se3.so3_exp([0.0, 0.0, 1.1])
    turned, still = (estimate_normals(cloud, thin_m=0.0) for cloud in (points @ R.T, points))
    same = np.abs(np.einsum("ij,ij->i", turned, still @ R.T)) > 0.999
    assert same.mean() > 0.9  # ties between neighbours may be broken differently


def test_threads_do_not_change_the_result(rng):
    points = rng.normal(size=(3000, 3)) * 3
    assert np.array_equal(estimate_normals(points, threads=1), estimate_normals(points, threads=2))


def test_a_lone_return_and_one_that_is_not_finite_have_no_normal(rng):
    plane = np.column_stack([rng.uniform(-5, 5, (1000, 2)), np.full(1000, -2.0)])
    points = np.vstack([plane, [[50.0, 0.0, 5.0], [np.nan, 0.0, 0.0]]])
    normals = estimate_normals(points)
    assert not normals[-2:].any()
    assert np.allclose(np.linalg.norm(normals[:-2], axis=1), 1.0, atol=1e-5)


def test_one_point_very_far_away_does_not_hide_the_others(rng):
    plane = np.column_stack([rng.uniform(-5, 5, (1000, 2)), np.full(1000, -2.0)])
    normals = estimate_normals(np.vstack([plane, [[1e5, 1e5, 1e5]]]))
    assert worst_angle_deg(normals[:-1], np.broadcast_to([0.0, 0.0, 1.0], (1000, 3))) < 0.1


@pytest.mark.parametrize("points", [np.empty((0, 3)), np.ones((4, 3)), np.full((100, 3), 4.0), np.full((9, 3), np.nan)])
def test_a_cloud_without_a_surface_has_no_normals(points):
    normals = estimate_normals(points)
    assert normals.shape == points.shape
    assert not normals.any()


@pytest.mark.parametrize("wrong", [{"neighbours": 4}, {"threads": 0}, {"support_m": 0.0}, {"thin_m": -1.0}])
def test_settings_that_cannot_fit_a_plane_are_errors(wrong):
    with pytest.raises(ConfigError, match="normals"):
        estimate_normals(np.ones((10, 3)), **wrong)


def test_most_points_of_a_real_scan_lie_on_surfaces(kitti_raw_root):
    scan = kitti_raw_root / "2011_09_26/2011_09_26_drive_0005_sync/velodyne_points/data/0000000050.bin"
    points = np.fromfile(scan, np.float32).reshape(-1, 4)[:, :3]
    normals = estimate_normals(points)
    assert (np.einsum("ij,ij->i", normals, points) <= 1e-4).all()
    road = (np.linalg.norm(points[:, :2], axis=1) < 10) & (points[:, 2] < -1.6)
    assert np.degrees(np.arccos(np.median(normals[road, 2]))) < 3.0
    literal = estimate_normals(points, thin_m=0.0)  # the module docstring's claim about fits to the points themselves
    assert np.degrees(np.arccos(np.median(literal[road, 2]))) > 7.0
