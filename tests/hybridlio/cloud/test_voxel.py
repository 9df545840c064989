import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridlio.cloud import voxel
from hybridlio.cloud.voxel import voxel_average, voxel_pick, voxel_to_count
from hybridlio.core.errors import ConfigError, DataError


def street(seed: int, count: int = 110_000) -> np.ndarray:
    """A cloud, dense near the sensor and sparse far away, of a road, two facades and scattered points."""
    rng = np.random.default_rng(seed)
    reach = np.exp(rng.uniform(np.log(3), np.log(80), count)) * rng.choice([-1, 1], count)
    road = np.column_stack([reach, rng.uniform(-8, 8, count), rng.normal(-1.7, 0.02, count)])
    fronts = np.column_stack(
        [reach, rng.normal(8, 0.03, count) * rng.choice([-1, 1], count), rng.uniform(-1.7, 6, count)]
    )
    scatter = np.column_stack([reach, rng.normal(0, 10, count), rng.uniform(-1, 4, count)])
    return np.choose(rng.integers(0, 3, count)[:, None], [road, fronts, scatter]).astype(np.float32)


def by_dictionary(points, normals, size):
    """Return the same averages by a dictionary, one point at a time."""
    cells: dict[tuple, list[int]] = {}
    for i, cell in enumerate(np.floor(points / np.float32(size)).astype(int)):
        cells.setdefault(tuple(cell), []).append(i)
    order = sorted(cells, key=lambda c: c[::-1])
    means = np.array([points[cells[c]].astype(float).mean(axis=0) for c in order])
    sums = np.array([normals[cells[c]].astype(float).sum(axis=0) for c in order])
    return means, sums / np.linalg.norm(sums, axis=1, keepdims=True)


@pytest.mark.parametrize("size", [0.01, 0.3, 1.0, 7.0])
def test_averages_equal_those_of_a_dictionary(size):
    points = street(0, 3000)
    normals = np.random.default_rng(1).normal(size=points.shape).astype(np.float32)
    means, units = by_dictionary(points, normals, size)
    got_means, got_units = voxel_average(points, normals, size)
    assert np.allclose(got_means, means, atol=1e-4)
    assert np.allclose(got_units, units, atol=1e-4)
    assert len(got_means) == len(means)


def test_negative_coordinates_do_not_share_the_voxel_at_the_origin():
    points = np.array([[0.1, 0.1, 0.1], [-0.1, 0.1, 0.1], [0.1, -0.1, 0.1], [0.1, 0.1, -0.1]])
    assert len(voxel_average(points, None, 1.0)[0]) == 4


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_order_of_the_points_does_not_matter(seed):
    points = street(4, 2000)
    shuffled = np.random.default_rng(seed).permutation(points)
    assert np.allclose(voxel_average(points, None, 0.7)[0], voxel_average(shuffled, None, 0.7)[0], atol=1e-5)


def test_averaging_twice_over_the_same_grid_changes_nothing():
    once, _ = voxel_average(street(2, 5000), None, 0.5)
    twice, _ = voxel_average(once, None, 0.5)
    assert len(twice) == len(once)
    assert np.allclose(twice, once)


def test_points_without_a_normal_are_ignored_in_the_mean_normal():
    points = np.array([[0.1, 0.1, 0.1], [0.2, 0.2, 0.2], [5.5, 0.1, 0.1]])
    normals = np.array([[0.0, 0.6, 0.8], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    means, averaged = voxel_average(points, normals, 1.0)
    assert np.allclose(means, [[0.15, 0.15, 0.15], [5.5, 0.1, 0.1]])
    assert np.allclose(averaged, [[0.0, 0.6, 0.8], [0.0, 0.0, 0.0]])


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("count", "tolerance"), [(10240, 100), (1000, 20), (50_000, 100)])
def test_the_count_is_met_within_its_tolerance(seed, count, tolerance):
    points = street(seed)
    cloud = voxel_to_count(points, np.ones_like(points), count, tolerance)
    assert abs(len(cloud) - count) <= tolerance
    assert len(cloud) == len(cloud.normals) == len(voxel_average(points, None, cloud.voxel_size_m)[0])


def test_the_search_for_a_side_takes_few_passes(monkeypatch):
    passes = []
    counted = voxel.voxel_count
    monkeypatch.setattr(voxel, "voxel_count", lambda *a: passes.append(1) or counted(*a))
    voxel_to_count(street(0))
    assert len(passes) <= 8


@pytest.mark.parametrize("start", [1e-3, 0.05, 3.0, 500.0])
def test_a_poor_first_side_still_reaches_the_count(start):
    assert abs(len(voxel_to_count(street(1), start_size_m=start)) - 10240) <= 100


def test_a_small_cloud_comes_back_as_it_is_with_unit_normals():
    points = street(0, 10_300)
    cloud = voxel_to_count(points, 2 * np.ones_like(points))
    assert np.array_equal(cloud.points, points)
    assert np.allclose(np.linalg.norm(cloud.normals, axis=1), 1.0)
    assert cloud.voxel_size_m == 0.0


def test_a_cloud_with_too_few_distinct_places_gives_all_of_them():
    places = street(0, 50)
    cloud = voxel_to_count(np.repeat(places, 400, axis=0), count=10_000)
    assert len(cloud) == len(np.unique(places, axis=0))


def test_points_in_one_place_average_to_that_place():
    cloud = voxel_to_count(np.full((20_000, 3), 4.2, np.float32), count=100, tolerance=0)
    assert cloud.points == pytest.approx(np.full((1, 3), 4.2))


def test_a_count_below_the_number_of_octants_gives_one_point_per_octant():
    assert len(voxel_to_count(street(0, 1000), count=1, tolerance=0)) == 8


def test_a_cloud_of_no_points_stays_empty():
    cloud = voxel_to_count(np.empty((0, 3)), np.empty((0, 3)))
    assert cloud.points.shape == cloud.normals.shape == (0, 3)
    assert voxel_average(np.empty((0, 3)), None, 0.3)[0].shape == (0, 3)


def test_picked_points_are_the_nearest_to_the_mean_of_each_voxel():
    points = street(3, 2000)
    means, _ = voxel_average(points, None, 1.0)
    picked = points[voxel_pick(points, 1.0)]
    off2 = ((points[:, None] - means) ** 2).sum(axis=2)
    inside = (np.floor(points[:, None]) == np.floor(picked)).all(axis=2)
    assert picked.shape == means.shape
    for k in range(len(means)):
        own = np.flatnonzero(inside[:, k])
        assert off2[own, k].min() == pytest.approx(((picked[k] - means[k]) ** 2).sum(), abs=1e-6)


def test_picked_points_in_a_corner_lie_on_a_wall():
    t = np.linspace(0.01, 0.99, 50)
    corner = np.concatenate([np.column_stack([t, 0 * t, 0 * t]), np.column_stack([0 * t, t, 0 * t])])
    (mean,), (picked,) = voxel_average(corner, None, 1.0)[0], corner[voxel_pick(corner, 1.0)]
    assert mean[:2].min() > 0.2
    assert picked[:2].min() == 0


def test_nothing_is_picked_of_an_empty_cloud():
    assert voxel_pick(np.empty((0, 3)), 1.0).shape == (0,)


def test_points_that_are_not_finite_are_left_out():
    points = np.array([[1, 1, 1], [np.nan, 1, 1], [1, np.inf, 1]])
    means, normals = voxel_average(points, np.ones((3, 3)), 0.3)
    assert np.allclose(means, 1.0)
    assert normals.shape == (1, 3)


@pytest.mark.parametrize("size", [0.0, -1.0, np.nan, np.inf])
def test_an_invalid_voxel_side_is_an_error(size):
    with pytest.raises(ConfigError, match="positive"):
        voxel_average(np.ones((2, 3)), None, size)


def test_a_voxel_side_too_small_for_the_extent_is_an_error():
    with pytest.raises(ConfigError, match="too small"):
        voxel_average(np.array([[-1e5] * 3, [1e5] * 3]), None, 1e-9)


def test_normals_of_another_shape_than_the_points_are_an_error():
    with pytest.raises(DataError, match="normals"):
        voxel_to_count(np.ones((4, 3)), np.ones((3, 3)))


def test_real_scans_are_thinned_to_the_count_of_the_paper(kitti_raw_root):
    scans = sorted(kitti_raw_root.glob("*/*/velodyne_points/data/*.bin"))[::60]
    for scan in scans:
        points = np.fromfile(scan, np.float32).reshape(-1, 4)[:, :3]
        assert abs(len(voxel_to_count(points)) - 10240) <= 100
