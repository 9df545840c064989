import numpy as np
import pytest

from hybridlio.cloud import preparation
from hybridlio.cloud.deskew import constant_twist
from hybridlio.cloud.map_geometry import MAP_GEOMETRIES
from hybridlio.cloud.preparation import PreparationOptions, prepare
from hybridlio.cloud.projection import normal_map, vertex_map
from hybridlio.core import se3
from hybridlio.core.errors import ConfigError
from hybridlio.core.sensors import Scan


@pytest.fixture
def town(rng) -> Scan:
    """A road between two walls, 30,000 points."""
    along, side = rng.uniform(-40, 40, 30_000), rng.choice([-1, 1], 30_000)
    road = np.column_stack([along, rng.uniform(-9, 9, 30_000), rng.normal(-1.7, 0.02, 30_000)])
    walls = np.column_stack([along, 9.0 * side, rng.uniform(-1.7, 4, 30_000)])
    return Scan(5, np.where(rng.random((30_000, 1)) < 0.4, road, walls))


def test_points_out_of_range_are_dropped_with_their_intensity():
    points = [[0, 0, 0], [0.5, 0, 0], [1.5, 0, 0], [50, 0, 0], [200, 0, 0]]
    prepared = prepare(Scan(7, np.array(points), np.arange(5.0)))
    assert prepared.points.tolist() == [[1.5, 0, 0], [50, 0, 0]]
    assert prepared.scan.intensity.tolist() == [2.0, 3.0]
    assert prepared.stamp_ns == 7


def test_maps_are_of_the_cropped_scan_with_the_given_geometry(town):
    geometry = MAP_GEOMETRIES["32-beam"]
    prepared = prepare(town, PreparationOptions(geometry=geometry))
    assert np.array_equal(prepared.vertex_map, vertex_map(prepared.points, geometry))
    assert np.array_equal(prepared.normal_map, normal_map(prepared.vertex_map))


def test_the_loss_cloud_has_the_requested_count_and_no_ground(town):
    prepared = prepare(town, PreparationOptions(loss_points=2000, loss_tolerance=40))
    assert prepared.ground.offset_m == pytest.approx(1.7, abs=0.02)
    cloud = prepared.loss_cloud
    assert abs(len(cloud) - 2000) <= 40
    assert (cloud.points[:, 2] > -1.7 + 0.1).all()
    assert np.median(np.abs(cloud.normals[:, 1])) > 0.99  # the normals of the walls


def test_ground_stays_in_the_loss_cloud_on_request(town):
    cloud = prepare(town, PreparationOptions(remove_ground=False, loss_points=3000)).loss_cloud
    assert (cloud.points[:, 2] < -1.6).mean() > 0.2


def test_parts_are_computed_only_when_read(town, monkeypatch):
    def never(*args):
        raise AssertionError("computed although not requested")

    for name in ("vertex_map", "normal_map", "estimate_normals", "find_ground", "voxel_to_count"):
        monkeypatch.setattr(preparation, name, never)
    prepared = prepare(town)
    assert 0 < len(prepared.thinned) < len(prepared.points)
    assert prepared.thinned is prepared.thinned  # computed only once


def test_a_moving_sweep_is_compensated_and_one_without_times_is_not(town):
    motion = constant_twist(se3.exp([0, 0, 0, 2.0, 0, 0]), 0, 100_000_000)
    timed = Scan(0, town.points, None, np.full(len(town), 50_000_000))
    assert np.allclose(prepare(timed, motion=motion).points, town.points + np.array([1, 0, 0]), atol=1e-5)
    assert np.array_equal(prepare(town, motion=motion).points, town.points)
    assert prepare(timed).scan.time_offsets_ns is not None


@pytest.mark.parametrize("points", [np.empty((0, 3)), np.zeros((500, 3)), np.full((500, 3), np.nan)])
def test_an_empty_scan_is_not_usable_and_has_empty_parts(points):
    prepared = prepare(Scan(0, points))
    assert not prepared.usable
    assert not prepared.vertex_map.any()
    assert not prepared.normal_map.any()
    assert not prepared.ground.found
    assert len(prepared.thinned) == len(prepared.loss_cloud) == 0


def test_a_scan_all_in_one_place_gives_one_point_without_a_normal():
    prepared = prepare(Scan(0, np.full((20_000, 3), 4.0)))
    assert len(prepared.thinned) == len(prepared.loss_cloud) == 1
    assert not prepared.loss_cloud.normals.any()


@pytest.mark.parametrize("wrong", [{"min_range_m": 5.0, "max_range_m": 4.0}, {"thinned_voxel_m": 0.0}])
def test_options_that_leave_no_points_are_errors(wrong):
    with pytest.raises(ConfigError, match="preparation"):
        PreparationOptions(**wrong)


def test_a_real_scan_gives_every_part_in_the_requested_size(kitti_raw_root):
    scan = kitti_raw_root / "2011_09_26/2011_09_26_drive_0005_sync/velodyne_points/data/0000000050.bin"
    columns = np.fromfile(scan, np.float32).reshape(-1, 4)
    prepared = prepare(Scan(0, columns[:, :3], columns[:, 3]))
    assert prepared.usable
    assert abs(len(prepared.loss_cloud) - 10240) <= 100
    assert prepared.vertex_map.any(axis=0).mean() > 0.8
    assert prepared.normal_map.any(axis=0).mean() > 0.7
