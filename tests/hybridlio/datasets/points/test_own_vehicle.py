"""Points of the vehicle are noticed while it moves, and left out where the user states their box."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from hybridlio.core.errors import DataError
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.points.own_vehicle import note_vehicle
from hybridlio.datasets.points.point_files import open_point_files
from hybridlio.datasets.points.point_format import Box, StatedFormat

BONNET = np.random.default_rng(0).uniform([0.8, -0.6, -1.2], [1.6, 0.6, -1.0], (300, 3))


def scene(k: int) -> np.ndarray:
    """A scan with the bonnet in it, and walls that pass by."""
    rng = np.random.default_rng(k + 1)
    walls = rng.uniform([-30, -9, -2], [30, 9, 3], (3000, 3))
    bonnet = BONNET + rng.normal(0, 0.01, BONNET.shape)
    return np.vstack([walls[np.abs(walls[:, 1]) > 3], bonnet]).astype(np.float32)


def test_the_note_states_a_box_around_the_vehicle() -> None:
    notes = Notes("test")
    note_vehicle([scene(k) for k in range(5)], notes)
    (text,) = notes.texts
    box = yaml.safe_load(text.split("'")[1])["vehicle"]
    inside = (np.array(box["min"]) - 0.1 <= BONNET) & (np.array(box["max"]) + 0.1 >= BONNET)
    assert inside.all(axis=1).mean() > 0.95
    assert np.ptp([box["min"], box["max"]], axis=0).max() < 2.0


def test_a_standing_vehicle_is_not_taken_for_its_surroundings() -> None:
    notes = Notes("test")
    note_vehicle([scene(0) for _ in range(5)], notes)
    assert notes.texts == []


def test_a_moving_scene_without_the_vehicle_gets_no_note() -> None:
    notes = Notes("test")
    note_vehicle([scene(k)[: -len(BONNET)] for k in range(5)], notes)
    assert notes.texts == []


def ring_ground(tilt: float) -> np.ndarray:
    """The rings of a spinning lidar on a plane of ground, the same in each scan while it moves."""
    azimuth, radius = np.meshgrid(np.linspace(-np.pi, np.pi, 900), [2.2, 2.7, 3.4, 4.4, 6.0, 9.1])
    x, y = (radius * np.cos(azimuth)).ravel(), (radius * np.sin(azimuth)).ravel()
    return np.column_stack([x, y, tilt * x - 1.7])


@pytest.mark.parametrize("tilt", [0.0, 0.2])
def test_rings_on_flat_ground_are_not_the_vehicle(tilt: float) -> None:
    rng, notes, with_bonnet = np.random.default_rng(2), Notes("test"), Notes("test")
    clouds = [
        np.vstack([scene(k)[: -len(BONNET)], ring_ground(tilt) + rng.normal(0, 0.01, (5400, 3))]) for k in range(5)
    ]
    clouds = [cloud[cloud[:, 2] > tilt * cloud[:, 0] - 1.8] for cloud in clouds]  # nothing is below the ground
    note_vehicle(clouds, notes)
    assert notes.texts == []
    note_vehicle([np.vstack([cloud, scene(k)[-len(BONNET) :]]) for k, cloud in enumerate(clouds)], with_bonnet)
    (text,) = with_bonnet.texts
    box = yaml.safe_load(text.split("'")[1])["vehicle"]
    assert np.ptp([box["min"], box["max"]], axis=0).max() < 2.0, "of the bonnet, without the ground"


def test_a_room_without_farther_points_does_not_say_whether_the_vehicle_moves() -> None:
    notes = Notes("test")
    walls = scene(0)
    note_vehicle([walls[np.abs(walls).max(axis=1) < 4] for _ in range(5)], notes)
    assert notes.texts == []


def test_points_in_the_stated_box_are_left_out(tmp_path: Path) -> None:
    paths = tuple(tmp_path / f"{k}.npy" for k in range(3))
    for k, path in enumerate(paths):
        np.save(path, scene(k))
    stated = StatedFormat(vehicle=Box((0.5, -1.0, -1.5), (2.0, 1.0, -0.5)))
    load = open_point_files(paths, np.arange(3) * 10**8, Notes("test"), stated=stated)
    scan = load(1)
    assert 0 < len(scan) <= len(scene(1)) - len(BONNET)
    inside = (scan.points >= [0.5, -1.0, -1.5]) & (scan.points <= [2.0, 1.0, -0.5])
    assert not inside.all(axis=1).any()


def test_points_of_a_map_are_refused_when_opening(tmp_path: Path) -> None:
    paths = tuple(tmp_path / f"{k}.npy" for k in range(3))
    for k, path in enumerate(paths):
        np.save(path, scene(k).astype(np.float64) + np.array([690_000.0, 5_330_000.0, 500.0]))
    with pytest.raises(DataError, match=r"5374 km from the origin, as in a map's frame \(UTM\)"):
        open_point_files(paths, np.arange(3) * 10**8, Notes("test"))
