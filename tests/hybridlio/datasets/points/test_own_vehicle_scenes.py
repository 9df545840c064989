"""In simulated scenes nothing but the carrier is taken for it, however short the walk, and the carrier is found."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from hybridlio.core.arrays import Floats
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.points.own_vehicle import note_vehicle
from hybridlio.datasets.registry import open_sequence
from hybridlio.simulation.platforms.config import PlatformConfig
from hybridlio.simulation.platforms.simulate import simulate_platform

SCANS = 5
# In each of these some surface slides along itself for half a second: ground, desks, a ceiling, a trunk.
WALKS = [("campus", "os0", 3), ("office", "vlp-16", 1), ("room", "mid360", 2), ("forest", "os0", 1)]


@pytest.fixture(scope="module", params=WALKS, ids=lambda walk: f"{walk[0]}-{walk[1]}")
def walk(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> list[Floats]:
    scene, lidar, seed = request.param
    return scans(tmp_path_factory.mktemp("walk"), PlatformConfig(scene=scene, lidar=lidar, seed=seed, seconds=0.5))


def scans(folder: Path, config: PlatformConfig) -> list[Floats]:
    sequence = open_sequence(simulate_platform(folder / "walk", config))
    return [sequence[k].scan.points for k in range(SCANS)]


def noted(clouds: list[Floats]) -> tuple[str, ...]:
    notes = Notes("test")
    note_vehicle(clouds, notes)
    return tuple(notes.texts)


def with_operator(cloud: Floats, rng: np.random.Generator) -> Floats:
    """Return a scan with the back half hidden by a person, who sways by 3 cm."""
    azimuth, height = rng.uniform(-np.pi / 2, np.pi / 2, 1200), rng.uniform(-0.9, 0.3, 1200)
    width = np.where(height > 0.1, 0.1, 0.22)  # of the head and the chest
    person = np.column_stack([width * np.cos(azimuth) - 0.6, width * np.sin(azimuth), height])
    person += rng.normal(0, 0.03, 3) + rng.normal(0, 0.02, person.shape)
    seen = np.abs(np.arctan2(cloud[:, 1], -cloud[:, 0])) > np.radians(30)
    return np.vstack([cloud[seen], person]).astype(np.float32)


def test_nothing_of_the_scene_is_taken_for_the_carrier(walk: list[Floats]) -> None:
    assert noted(walk) == ()


def test_the_person_who_carries_the_lidar_is_found(walk: list[Floats]) -> None:
    rng = np.random.default_rng(1)
    (text,) = noted([with_operator(cloud, rng) for cloud in walk])
    box = yaml.safe_load(text.split("'")[1])["vehicle"]
    assert np.all(np.array(box["min"]) > [-1.2, -0.7, -1.4])
    assert np.all(np.array(box["max"]) < [0.0, 0.7, 0.7])


@pytest.mark.parametrize("lidar", ["mid360", "vlp-16"])
def test_at_rest_nothing_is_taken_for_the_carrier(lidar: str, tmp_path: Path) -> None:
    config = PlatformConfig(scene="room", lidar=lidar, seed=4, seconds=0.5, start_moving=False)
    clouds = scans(tmp_path, config)
    rng = np.random.default_rng(1)
    assert noted(clouds) == noted([with_operator(cloud, rng) for cloud in clouds]) == ()
