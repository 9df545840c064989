import numpy as np
import pytest

from hybridlio.cloud.ground import GroundOptions, find_ground, remove_ground
from hybridlio.cloud.normals import estimate_normals
from hybridlio.core import se3
from hybridlio.core.errors import ConfigError, DataError

HEIGHT_M = 1.7


def road(rng, count, noise_m=0.03):
    reach = np.exp(rng.uniform(np.log(3), np.log(50), count))
    angle = rng.uniform(0, 2 * np.pi, count)
    return np.column_stack([reach * np.cos(angle), reach * np.sin(angle), rng.normal(-HEIGHT_M, noise_m, count)])


def wall(rng, count, distance_m=10.0, foot_m=-HEIGHT_M, top_m=8.0, azimuth_rad=0.0):
    flat = np.column_stack([np.full(count, distance_m), rng.uniform(-20, 20, count), rng.uniform(foot_m, top_m, count)])
    return flat @ se3.so3_exp([0, 0, azimuth_rad]).T


def four_walls(rng, count, **more):
    return np.vstack([wall(rng, count // 4, azimuth_rad=k * np.pi / 2, **more) for k in range(4)])


@pytest.mark.parametrize("tilt_deg", [(0, 0), (10, 0), (-10, 0), (0, 10), (0, -10), (5, -6)])
def test_the_plane_under_the_sensor_is_found_on_slopes(rng, tilt_deg):
    ground, town = road(rng, 6000), four_walls(rng, 6000, distance_m=15.0, foot_m=-0.5)
    R = se3.so3_exp(np.radians([*tilt_deg, 0]))
    found = find_ground(np.vstack([ground, town]) @ R.T)
    assert found.found
    assert np.degrees(np.arccos(found.normal @ R[:, 2])) < 0.2
    assert found.offset_m == pytest.approx(HEIGHT_M, abs=0.02)
    assert found.mask[:6000].all()
    assert found.mask[6000:].mean() < 0.01


def test_a_slope_steeper_than_the_limit_is_not_ground(rng):
    R = se3.so3_exp([np.radians(25), 0, 0])
    assert not find_ground(road(rng, 5000) @ R.T).found
    assert find_ground(road(rng, 5000) @ R.T, options=GroundOptions(max_slope_deg=30)).found


def test_little_ground_between_walls_is_found(rng):
    points = np.vstack([road(rng, 1500), four_walls(rng, 8500)])
    found = find_ground(points)
    assert np.degrees(np.arccos(found.normal[2])) < 0.5
    assert found.mask[:1500].all()


def test_with_normals_five_percent_of_ground_is_found(rng):
    points = np.vstack([road(rng, 1000), four_walls(rng, 19_000, foot_m=-4.0)])
    normals = np.vstack([np.tile([0.0, 0.0, 1.0], (1000, 1)), np.tile([-1.0, 0.0, 0.0], (19_000, 1))])
    found = find_ground(points, normals)
    assert found.offset_m == pytest.approx(HEIGHT_M, abs=0.02)
    assert found.mask[:1000].all()


@pytest.mark.parametrize("seed", range(3))
def test_walls_scattered_points_and_a_ceiling_are_not_ground(seed):
    rng = np.random.default_rng(seed)
    ceiling = road(rng, 5000) * [1, 1, -1]
    scatter = rng.uniform([-20, -20, -3], [20, 20, 3], (20_000, 3))
    for cloud in (wall(rng, 5000), four_walls(rng, 8000), ceiling, scatter):
        found = find_ground(cloud)
        assert not found.found
        assert not found.mask.any()
        assert found.offset_m == 0.0


@pytest.mark.parametrize(
    "cloud",
    [np.empty((0, 3)), *(np.full((n, 3), value) for n, value in [(2, -1.0), (500, -1.0), (9, np.nan), (50, 0.0)])],
)
def test_clouds_without_a_plane_have_no_ground(cloud):
    assert find_ground(cloud).mask.tolist() == [False] * len(cloud)
    assert find_ground(cloud, np.zeros_like(cloud)).mask.tolist() == [False] * len(cloud)


def test_a_single_ring_of_points_is_not_ground():
    y = np.linspace(-5, 5, 1000)
    assert not find_ground(np.column_stack([np.full(1000, 8.0), y, np.full(1000, -1.7)])).found


def test_points_that_are_not_finite_are_never_ground(rng):
    points = road(rng, 2000)
    points[::7] = np.nan
    mask = find_ground(points).mask
    assert not mask[::7].any()
    assert mask.sum() == 2000 - len(points[::7])


def test_the_same_cloud_gives_the_same_ground(rng):
    points = np.vstack([road(rng, 3000), four_walls(rng, 7000)])
    first, second = find_ground(points), find_ground(points)
    assert np.array_equal(first.mask, second.mask)
    assert np.array_equal(first.normal, second.normal)


def test_removing_ground_keeps_all_other_points(rng):
    ground, town = road(rng, 3000), four_walls(rng, 3000, foot_m=0.0)
    assert np.allclose(remove_ground(np.vstack([ground, town])), town, atol=1e-5)


@pytest.mark.parametrize("wrong", [{"threshold_m": 0}, {"max_slope_deg": 90}, {"min_share": 2}, {"samples": 2}])
def test_options_out_of_range_are_errors(wrong):
    with pytest.raises(ConfigError, match="ground"):
        GroundOptions(**wrong)


def test_normals_and_points_of_wrong_shapes_are_errors():
    with pytest.raises(DataError, match="normals"):
        find_ground(np.ones((5, 3)), np.ones((4, 3)))
    with pytest.raises(DataError, match="points"):
        find_ground(np.ones((5, 2)))


def test_the_road_under_kittis_car_is_1_73_metres_below_the_lidar(kitti_raw_root):
    for scan in sorted(kitti_raw_root.glob("*/*/velodyne_points/data/*.bin"))[::60]:
        points = np.fromfile(scan, np.float32).reshape(-1, 4)[:, :3]
        for normals in (None, estimate_normals(points)):
            found = find_ground(points, normals)
            assert found.offset_m == pytest.approx(1.73, abs=0.07)
            assert np.degrees(np.arccos(found.normal[2])) < 3.0
