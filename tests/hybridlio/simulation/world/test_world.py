"""The simulated world: ground, objects, scans of it."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from hybridlio.simulation.config import SimulationConfig
from hybridlio.simulation.measurements import scan_at
from hybridlio.simulation.plan import Drive, plan
from hybridlio.simulation.rig import LIDAR_HEIGHT_M, T_IMU_LIDAR
from hybridlio.simulation.sensors.lidar import ray_pattern
from hybridlio.simulation.world.ground import CURB_HEIGHT_M, CURB_OFFSET_M, Ground, land_along, waves
from hybridlio.simulation.world.rays import RayScene
from hybridlio.simulation.world.street import car as street_car
from hybridlio.simulation.world.world import TILE_M, World


@pytest.fixture(scope="module")
def town() -> Drive:
    return plan(SimulationConfig(seconds=20.0, seed=2))


def test_waves_have_the_given_slope(rng: np.random.Generator):
    xy, h = rng.uniform(-2000, 2000, (20000, 2)), 1e-3
    surface = waves(rng, 24, (20.0, 60.0), 0.03)
    slope = [(surface(xy + step) - surface(xy - step)) / (2 * h) for step in h * np.eye(2)]
    assert np.hypot(*slope).std() == pytest.approx(0.03 * np.sqrt(1 - np.pi / 4), rel=0.35)
    assert np.sqrt(np.mean(np.square(slope).sum(axis=0))) == pytest.approx(0.03, rel=0.1)


def test_land_along_a_path_passes_through_it():
    s = np.arange(0.0, 400.0, 1.0)
    points = np.column_stack([s, 30 * np.sin(s / 60), 4 * np.sin(s / 80)])
    land = land_along(points)
    assert np.abs(land(points[:, :2]) - points[:, 2])[10:-10].max() < 0.05
    assert np.isfinite(land(np.array([[5000.0, -5000.0]]))).all()


def flat_ground() -> Ground:
    def level(xy: np.ndarray) -> np.ndarray:
        return np.zeros(len(xy))

    return Ground(level, level, level, cKDTree(np.column_stack([np.arange(-200, 200, 0.5), np.zeros(800)])))


def test_the_road_has_camber_and_a_curb():
    middle, edge, walk = flat_ground().height(np.array([[0.0, 0.0], [0.0, CURB_OFFSET_M - 0.1], [0.0, 6.0]]))
    assert middle > edge
    assert walk - edge == pytest.approx(CURB_HEIGHT_M, abs=0.01)


def test_the_ground_mesh_has_the_grounds_heights():
    ground = flat_ground()
    patch = ground.patch(np.array([0.0, -8.0]), 16.0, 0.5)
    np.testing.assert_allclose(patch.vertices[:, 2], ground.height(patch.vertices[:, :2]), atol=1e-12)
    a, b, c = (patch.vertices[patch.triangles[:, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    assert (normal[:, 2] > 0).all()
    assert normal[:, 2].sum() / 2 == pytest.approx(16.0**2)


def test_no_object_is_on_the_lane(town: Drive):
    poses = town.path.poses(town.scan_times_s[::4]) @ T_IMU_LIDAR
    directions = np.column_stack([np.cos(a := np.linspace(0, 2 * np.pi, 90)), np.sin(a), 0 * a])
    for pose in poses:
        scene = town.world.scene_around(pose[:3, 3])
        for height in (0.5, 1.2):
            origin = pose[:3, 3] - [0.0, 0.0, LIDAR_HEIGHT_M - height]
            hits = scene.cast(np.tile(origin, (90, 1)), directions)
            assert hits.range_m.min() > 1.3


def test_the_lidar_is_at_its_mounting_height_above_the_ground(town: Drive):
    poses = town.path.poses(town.scan_times_s) @ T_IMU_LIDAR
    above = poses[:, 2, 3] - town.world.ground.height(poses[:, :2, 3])
    assert np.abs(above - LIDAR_HEIGHT_M).max() < 0.15


def test_rebuilding_a_tile_gives_the_same_mesh(town: Drive):
    fresh = World(town.world.ground, town.world.items, town.world.seed)
    tile = (int(town.world.items[3].x // TILE_M), int(town.world.items[3].y // TILE_M))
    fresh.tile_mesh((tile[0] + 1, tile[1]))
    np.testing.assert_array_equal(fresh.tile_mesh(tile).vertices, town.world.tile_mesh(tile).vertices)


def test_a_scan_does_not_depend_on_earlier_scans(town: Drive):
    config = SimulationConfig(seconds=20.0, seed=2, lidar="16-beam")
    pattern = ray_pattern(config.lidar_model)
    for k in (0, 60):
        scan_at(town, k, pattern, config)
    again = scan_at(plan(config), 100, pattern, config)
    np.testing.assert_array_equal(scan_at(town, 100, pattern, config).points, again.points)


def test_a_scan_of_the_town_resembles_one_of_an_hdl_64e(town: Drive):
    config = SimulationConfig(seconds=20.0, seed=2)
    pattern = ray_pattern(config.lidar_model)
    for k in (0, 90, 199):
        scan = scan_at(town, k, pattern, config)
        assert 85_000 < len(scan) < 120_000
        ranges = np.linalg.norm(scan.points, axis=1)
        assert 5.0 < np.median(ranges) < 15.0
        assert ranges.max() > 40.0
        ground = scan.points[(ranges < 8.0) & (scan.points[:, 2] < -1.0), 2]
        assert np.median(ground) == pytest.approx(-LIDAR_HEIGHT_M, abs=0.15)
        assert scan.intensity is not None
        assert 0.1 < scan.intensity.mean() < 0.5


def test_a_town_has_every_kind_of_object(town: Drive):
    built = {getattr(item.build, "func", item.build).__name__ for item in town.world.items}
    assert {"house", "car", "tree", "bush", "pole", "sign"} <= built


def test_a_corridor_has_walls_and_a_field_is_nearly_empty():
    corridor, field = (plan(SimulationConfig(seconds=8.0, seed=1, scene=scene)) for scene in ("corridor", "field"))
    pose = (corridor.path.poses(4.0) @ T_IMU_LIDAR)[0]
    sideways = np.outer([1.0, -1.0], pose[:3, 1])
    walls = corridor.world.scene_around(pose[:3, 3]).cast(np.tile(pose[:3, 3], (2, 1)), sideways)
    assert walls.range_m.max() < 12.0
    assert len(field.world.items) < 250
    assert isinstance(field.world.scene_around(pose[:3, 3]), RayScene)


def test_another_drive_finds_the_same_town_with_other_cars(town: Drive):
    again = plan(SimulationConfig(seconds=20.0, seed=2, drive_seed=3))
    (standing, parked), (standing_again, parked_again) = (objects(drive) for drive in (town, again))
    assert standing == standing_again
    assert 0.1 < len(parked & parked_again) / len(parked) < 0.6
    assert len(parked_again) > 0.5 * len(parked)
    tile = next(iter(town.world._by_tile))
    houses = [tuple(drive.world.tile_mesh(tile).vertices[0]) for drive in (town, again)]
    assert houses[0] == houses[1]
    assert [car.shape_seed for car in town.cars] != [car.shape_seed for car in again.cars]
    where = [drive.path.poses(np.array([0.0]))[0, :2, 3] for drive in (town, again)]
    assert np.linalg.norm(where[1] - where[0]) < 5.0


def objects(drive: Drive) -> tuple[set[tuple[float, float]], set[tuple[float, float]]]:
    """Return the positions of what stands, and of the parked cars."""
    cars = {(item.x, item.y) for item in drive.world.items if item.build is street_car}
    return {(item.x, item.y) for item in drive.world.items} - cars, cars


def test_moving_cars_move_and_keep_clear_of_the_ego_car(town: Drive):
    assert town.cars
    times = town.scan_times_s
    ego = town.path.poses(times)[:, :3, 3]
    speeds = []
    for car in town.cars:
        there = np.array([car.present(t) for t in times])
        position = car.poses(times)[there, :3, 3]
        assert np.linalg.norm((position - ego[there])[:, :2], axis=1).min(initial=np.inf) > 2.9
        speeds.append(np.linalg.norm(np.diff(position, axis=0), axis=1).max(initial=0.0) * 10)
    assert max(speeds) > 5.0
