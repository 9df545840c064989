"""The simulated lidar: exact hits, the sweep, returns and noise."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from hybridlio.core import se3
from hybridlio.core.lidar_models import LIDAR_MODELS
from hybridlio.core.sensors import NS_PER_S
from hybridlio.simulation.drive.traffic import moving_car
from hybridlio.simulation.sensors.lidar import first_hits, measure, ray_pattern
from hybridlio.simulation.world.moving import MovingObject
from hybridlio.simulation.world.rays import Hits, RayScene
from hybridlio.simulation.world.shapes import boxes

MODEL = LIDAR_MODELS["16-beam"]
NOISELESS = replace(MODEL, range_sigma_m=0.0, dropout=0.0)
LOW, HIGH = np.array([-12.0, -7.0, -1.7]), np.array([15.0, 6.0, 3.0])
AT_REST = np.zeros(1)


def room() -> RayScene:
    return RayScene.of(boxes(LOW, HIGH, 0.5), np.array([2.0, 1.0, 0.0]))


def range_in_the_room(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return ranges in closed form: the nearest of the three walls that a ray points to."""
    with np.errstate(divide="ignore"):
        towards = np.where(directions > 0, HIGH - origins, LOW - origins) / directions
    return np.where(directions == 0, np.inf, towards).min(axis=1)


def out_of_the_room(points: np.ndarray) -> np.ndarray:
    """Return the signed distance of points to the nearest wall."""
    return np.minimum(points - LOW, HIGH - points).min(axis=1)


@pytest.mark.parametrize("name", LIDAR_MODELS)
def test_a_scan_of_a_room_equals_the_closed_form(name: str):
    pattern = ray_pattern(LIDAR_MODELS[name])
    pose = se3.exp([0.03, -0.02, 0.7, 1.0, -0.5, 0.2])
    hits = first_hits(room(), [], pattern, pose[None], AT_REST)
    directions = pattern.directions @ pose[:3, :3].T
    origins = np.broadcast_to(pose[:3, 3], directions.shape)
    np.testing.assert_allclose(hits.range_m, range_in_the_room(origins, directions), atol=2e-5)


def test_a_scan_of_the_ground_has_a_ring_per_downward_beam():
    ground = RayScene.of(boxes((-500, -500, -2.0), (500, 500, -1.5), 0.5), np.zeros(3))
    pattern = ray_pattern(MODEL)
    hits = first_hits(ground, [], pattern, np.eye(4)[None], AT_REST)
    elevation = np.repeat(np.radians(MODEL.elevations_deg), MODEL.columns)
    down = elevation < np.radians(-0.5)
    np.testing.assert_allclose(hits.range_m[down], 1.5 / -np.sin(elevation[down]), rtol=1e-5)
    np.testing.assert_allclose(hits.cosine[down], -np.sin(elevation[down]), atol=1e-5)
    assert not np.isfinite(hits.range_m[elevation > 0]).any()


def test_a_sweep_points_forward_at_its_stamp_and_turns_counter_clockwise():
    pattern = ray_pattern(MODEL)
    assert np.allclose(np.linalg.norm(pattern.directions, axis=1), 1.0)
    azimuth = np.arctan2(pattern.directions[:, 1], pattern.directions[:, 0])
    offset = pattern.column_offset_ns[pattern.column] / NS_PER_S
    np.testing.assert_allclose(azimuth, 2 * np.pi * MODEL.rate_hz * offset, atol=1e-7)
    assert offset.max() - offset.min() < 1 / MODEL.rate_hz


def moving_sweep(twist: list[float]) -> tuple[np.ndarray, np.ndarray]:
    times = ray_pattern(MODEL).column_offset_ns / NS_PER_S
    return times, se3.exp(times[:, None] * np.array(twist))


def test_compensating_a_distorted_scan_with_the_true_path_restores_the_room(rng: np.random.Generator):
    pattern, model = ray_pattern(MODEL), replace(MODEL, dropout=0.0)
    times, poses = moving_sweep([0.1, 0.05, 1.0, 15.0, 0.5, 0.1])
    scan = measure(first_hits(room(), [], pattern, poses, times), pattern, model, 0, True, rng)
    assert scan.time_offsets_ns is not None
    column = np.searchsorted(pattern.column_offset_ns, scan.time_offsets_ns)
    undistorted = (poses[column, :3, :3] @ scan.points[:, :, None])[..., 0] + poses[column, :3, 3]
    off = out_of_the_room(undistorted)
    assert off.std() < MODEL.range_sigma_m
    assert np.abs(off).max() < 6 * MODEL.range_sigma_m
    assert np.abs(out_of_the_room(scan.points)).max() > 0.4


def test_without_motion_a_sweep_equals_an_instantaneous_scan():
    pattern = ray_pattern(MODEL)
    times, poses = moving_sweep([0.0] * 6)
    swept = first_hits(room(), [], pattern, poses, times)
    instant = first_hits(room(), [], pattern, poses[:1], AT_REST)
    np.testing.assert_allclose(swept.range_m, instant.range_m, atol=1e-6)


def test_range_noise_and_dropouts_match_the_lidar_model(rng: np.random.Generator):
    pattern = ray_pattern(MODEL)
    hits = first_hits(room(), [], pattern, np.eye(4)[None], AT_REST)
    scan = measure(hits, pattern, replace(MODEL, dropout=0.2), 7, False, rng)
    assert scan.stamp_ns == 7
    assert scan.time_offsets_ns is None
    assert len(scan) / len(hits.range_m) == pytest.approx(0.8, abs=0.01)
    directions = scan.points / np.linalg.norm(scan.points, axis=1, keepdims=True)
    exact = range_in_the_room(np.zeros((1, 3)), directions.astype(np.float64))
    error = np.linalg.norm(scan.points, axis=1) - exact
    assert error.std() == pytest.approx(MODEL.range_sigma_m, rel=0.05)
    assert abs(error.mean()) < 4 * MODEL.range_sigma_m / np.sqrt(len(error))


def seen_at(range_m: float, cosine: float, rng: np.random.Generator) -> float:
    """Return the share of rays that a grey surface returns."""
    pattern = ray_pattern(NOISELESS)
    count = len(pattern.directions)
    hits = Hits(np.full(count, range_m), np.full(count, cosine), np.full(count, 0.25))
    return len(measure(hits, pattern, NOISELESS, 0, False, rng)) / count


def test_grazing_and_far_rays_have_no_return(rng: np.random.Generator):
    assert seen_at(30.0, 1.7 / 30.0, rng) > 0.99
    assert seen_at(99.0, 1.0, rng) > 0.99
    assert seen_at(95.0, 1.7 / 95.0, rng) < 0.05
    assert seen_at(MODEL.max_range_m + 0.1, 1.0, rng) == 0.0
    assert seen_at(MODEL.min_range_m - 0.1, 1.0, rng) == 0.0
    assert seen_at(np.inf, 0.0, rng) == 0.0


def test_no_hits_give_an_empty_scan(rng: np.random.Generator):
    pattern = ray_pattern(MODEL)
    sky = Hits(*(np.full(len(pattern.directions), v) for v in (np.inf, 0.0, 0.0)))
    assert len(measure(sky, pattern, MODEL, 0, False, rng)) == 0


def straight_car(speed: float) -> MovingObject:
    times = np.linspace(-5.0, 5.0, 21)
    return moving_car(CubicSpline(times, np.outer(times, [speed, 0, 0, 0]) + np.array([0.0, 3.5, -1.7, 0.0])), (1, 2))


def rays_on(car: MovingObject, times: np.ndarray) -> Hits:
    empty = RayScene.of(boxes((400, 400, 400), (401, 401, 401), 0.5), np.zeros(3))
    poses = np.broadcast_to(np.eye(4), (len(times), 4, 4))
    return first_hits(empty, [car], ray_pattern(MODEL), poses, times)


def test_a_moving_car_is_seen_at_its_position_at_that_time():
    pattern = ray_pattern(MODEL)
    for time in (-1.0, 0.0, 1.5):
        hits = rays_on(straight_car(8.0), np.array([time]))
        seen = np.isfinite(hits.range_m)
        points = pattern.directions[seen] * hits.range_m[seen, None]
        assert len(points) > 50
        assert np.abs(points[:, 0] - 8.0 * time).max() < 4.6
        assert points[:, 1].min() == pytest.approx(3.5 - 0.95, abs=0.25)


def test_a_car_passing_during_the_sweep_is_distorted_by_its_motion():
    pattern = ray_pattern(MODEL)
    times = pattern.column_offset_ns / NS_PER_S
    standing, passing = (rays_on(straight_car(v), times) for v in (0.0, 30.0))
    reach = []
    for hits in (standing, passing):
        seen = np.isfinite(hits.range_m)
        reach.append(np.ptp((pattern.directions[seen] * hits.range_m[seen, None])[:, 0]))
    # the beam turns backwards past a car on the left while the car drives forwards: it is cut short
    assert reach[1] < reach[0] - 0.2


def test_a_wall_hides_a_car_behind_it():
    wall = RayScene.of(boxes((-50, 2.0, -5), (50, 2.2, 5), 0.5), np.zeros(3))
    hits = first_hits(wall, [straight_car(0.0)], ray_pattern(MODEL), np.eye(4)[None], AT_REST)
    alone = first_hits(wall, [], ray_pattern(MODEL), np.eye(4)[None], AT_REST)
    np.testing.assert_array_equal(hits.range_m, alone.range_m)
