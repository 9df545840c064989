"""What a lidar sees through rain and dust."""

from dataclasses import replace

import numpy as np
import pytest

from hybridlio.core.lidar_models import LIDAR_MODELS
from hybridlio.simulation.plan import plan
from hybridlio.simulation.scenarios import scenario_config
from hybridlio.simulation.sensors.air import Air, DustClouds, look_through, rain_extinction_1_m
from hybridlio.simulation.sensors.lidar import first_hits, ray_pattern
from hybridlio.simulation.world.rays import Hits, RayScene
from hybridlio.simulation.world.shapes import boxes

MODEL = replace(LIDAR_MODELS["hdl-64e"], columns=360)
PATTERN = ray_pattern(MODEL)
HERE = np.eye(4)[None]


def wall_hits() -> Hits:
    """Return the hits of a wall all around, 40 m away."""
    walls = boxes([[-41, -41, -50], [-41, 40, -50], [-41, -41, -50], [40, -41, -50]],
                  [[41, -40, 50], [41, 41, 50], [-40, 41, 50], [41, 41, 50]], 0.5)  # fmt: skip
    return first_hits(RayScene.of(walls, np.zeros(3)), [], PATTERN, HERE, np.zeros(1))


def seen_through(air: Air, seed: int = 0) -> Hits:
    hits = wall_hits()
    look_through(air, hits, PATTERN, HERE, 0.0, MODEL, np.random.default_rng(seed))
    return hits


def cloud(distance_m: float, extinction_1_m: float = 0.3) -> DustClouds:
    centre, wind = np.array([[distance_m, 0.0, 0.0]]), np.array([0.0, 2.0, 0.0])
    return DustClouds(centre, np.zeros(1), wind, np.array([2.0]), np.array([extinction_1_m]))


def test_heavy_rain_takes_as_much_light_as_is_measured():
    # measured at 905 nm: a few per km at 25 mm/h (Rasshofer et al., Adv. Radio Sci. 2011)
    assert 1e-3 < rain_extinction_1_m(25.0) < 5e-3
    assert rain_extinction_1_m(50.0) > 1.3 * rain_extinction_1_m(25.0)


def test_rain_returns_near_points_before_far_walls_and_more_of_them_the_harder_it_rains():
    shares = []
    for rate in (5.0, 50.0):
        hits = seen_through(Air(rain_mm_h=rate))
        drops = hits.range_m < wall_hits().range_m
        assert hits.range_m[drops].max() < 20.0
        shares.append(float(drops.mean()))
    assert 0 < 2 * shares[0] < shares[1] < 0.2


def test_rain_weakens_what_is_behind_it():
    clear, hits = wall_hits(), seen_through(Air(rain_mm_h=50.0))
    walls = (hits.range_m == clear.range_m) & np.isfinite(clear.range_m)
    lost = np.exp(-2 * rain_extinction_1_m(50.0) * clear.range_m[walls])
    np.testing.assert_allclose(hits.reflectance[walls], clear.reflectance[walls] * lost)


def test_a_cloud_of_dust_returns_points_within_it_and_hides_what_is_behind():
    clear, hits = wall_hits(), seen_through(Air(dust=cloud(12.0)))
    dust = hits.range_m < clear.range_m
    points = PATTERN.directions[dust] * hits.range_m[dust, None]
    assert dust.sum() > 100
    assert np.linalg.norm(points - [12.0, 0.0, 0.0], axis=1).max() < 2.0 + 1e-6
    behind = ~dust & (hits.reflectance < clear.reflectance)
    assert (PATTERN.directions[behind, 0] > 0.9).all()


def test_thin_dust_lets_the_wall_be_seen():
    hits = seen_through(Air(dust=cloud(12.0, 0.01)))
    assert (hits.range_m < wall_hits().range_m).mean() < 1e-3


def test_clouds_drift_with_the_wind():
    np.testing.assert_allclose(cloud(12.0).centres_at(3.0), [[12.0, 6.0, 0.0]])


def test_rain_is_the_same_for_the_same_random_numbers():
    first, again, other = (seen_through(Air(rain_mm_h=50.0), seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.range_m, again.range_m)
    assert (first.range_m != other.range_m).any()


@pytest.mark.parametrize("name", ["rain", "dust"])
def test_weather_leaves_road_and_traffic_as_they_are(name: str):
    normal, weather = (plan(scenario_config(which, 2302, 60.0)) for which in ("normal", name))
    assert normal.air.is_clear
    assert not weather.air.is_clear
    assert [car.shape_seed for car in normal.cars] == [car.shape_seed for car in weather.cars]


def test_the_ego_car_drives_through_dust():
    drive = plan(scenario_config("dust", 2302, 100.0))
    assert drive.air.dust is not None
    gaps = []
    for time_s in drive.scan_times_s[::10]:
        away = drive.air.dust.centres_at(float(time_s)) - drive.path.poses(time_s)[0, :3, 3]
        gaps.append(float(np.linalg.norm(away[:, :2], axis=1).min()))
    assert min(gaps) < 5.0
