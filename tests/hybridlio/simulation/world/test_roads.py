"""Roads and driving along them."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from hybridlio.simulation.config import SimulationConfig
from hybridlio.simulation.plan import plan
from hybridlio.simulation.world.roads import Road, drive, generate_centreline


@pytest.mark.parametrize("scene", ["town", "corridor", "field"])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_road_is_long_enough_smooth_and_parametrised_by_arc_length(scene: str, seed: int):
    road = generate_centreline(np.random.default_rng(seed), 600.0, scene)
    assert road.length_m >= 600.0
    s = np.linspace(0.0, road.length_m, 3000)
    np.testing.assert_allclose(np.linalg.norm(road.curve(s, 1), axis=1), 1.0, atol=2e-3)
    assert np.abs(road.curvature(s)).max() < 1 / 7.0


def test_points_beside_a_circle_are_on_a_concentric_circle():
    angle = np.linspace(0.0, 3.0, 400)
    road = Road.through(30.0 * np.column_stack([np.cos(angle), np.sin(angle)]))
    s = np.linspace(5.0, 80.0, 40)
    np.testing.assert_allclose(np.linalg.norm(road.beside(s, 2.5), axis=1), 27.5, atol=1e-4)
    np.testing.assert_allclose(road.curvature(s), 1 / 30.0, rtol=1e-3)


def test_the_driver_brakes_for_bends_and_never_reverses():
    rng = np.random.default_rng(4)
    road = generate_centreline(rng, 900.0, "town")
    times = np.arange(0.0, 60.0, 0.01)
    s = drive(road, 0.0, 12.0, times, True, rng)
    speed = np.gradient(s, times)
    assert speed.min() > -1e-9
    assert speed.max() < 12.6
    assert np.abs(speed**2 * road.curvature(s)).max() < 3.0
    assert np.abs(np.gradient(speed, times)).max() < 5.0


def test_a_drive_starts_moving_or_at_rest():
    for start_moving in (True, False):
        path = plan(SimulationConfig(seconds=6.0, seed=8, start_moving=start_moving)).path
        speed = np.linalg.norm(path.motion([0.0, 1.0, 5.5]).velocity_m_s, axis=1)
        assert (speed[0] > 4.0) == start_moving
        assert (speed[1] < 1e-3) != start_moving
        assert speed[2] > 1.0


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_loops_revisit_places(seed: int):
    drive = plan(SimulationConfig(seconds=60.0, seed=seed, loops=True, traffic_per_km=0.0))
    position = drive.path.poses(drive.scan_times_s)[:, :3, 3]
    pairs = cKDTree(position).query_pairs(5.0, output_type="ndarray")
    apart = np.abs(drive.scan_times_s[pairs[:, 0]] - drive.scan_times_s[pairs[:, 1]])
    visited_again = np.unique(pairs[apart > 30.0])
    assert len(visited_again) > 50
