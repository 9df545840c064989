from __future__ import annotations

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.smoothing.place_recognition import (
    DescriptorSettings,
    descriptor_distances,
    descriptor_spectrum,
    place_descriptor,
    ring_key,
)

SETTINGS = DescriptorSettings(rings=12, sectors=40, range_m=40.0)
SECTOR_RAD = 2 * np.pi / SETTINGS.sectors


def place(rng: np.random.Generator) -> np.ndarray:
    """Ground and thirty pillars, with no point near a border of rings or sectors."""
    ring, sector = rng.integers(0, SETTINGS.rings, 230), rng.integers(0, SETTINGS.sectors, 230)
    distance = (ring + rng.uniform(0.2, 0.8, 230)) * SETTINGS.range_m / SETTINGS.rings
    angle = (sector + rng.uniform(0.2, 0.8, 230)) * SECTOR_RAD
    height = np.where(np.arange(230) < 30, rng.uniform(1.0, 7.0, 230), 0.0)
    return np.column_stack([distance * np.cos(angle), distance * np.sin(angle), height - 1.7])


def turned(points: np.ndarray, yaw: float) -> np.ndarray:
    """The same place seen by a sensor rotated by ``yaw`` to the left."""
    return points @ se3.so3_exp([0.0, 0.0, yaw])


def spectrum_of(points: np.ndarray) -> np.ndarray:
    return descriptor_spectrum(place_descriptor(points, SETTINGS))


@pytest.mark.parametrize("sectors", [1, 7, 20, 39])
def test_a_rotation_by_whole_sectors_only_shifts_them(rng: np.random.Generator, sectors: int):
    points = place(rng)
    before, after = place_descriptor(points, SETTINGS), place_descriptor(turned(points, sectors * SECTOR_RAD), SETTINGS)
    np.testing.assert_allclose(after, np.roll(before, -sectors, axis=1), atol=1e-6)
    np.testing.assert_allclose(ring_key(after), ring_key(before), atol=1e-6)


@pytest.mark.parametrize("sectors", [0, 3, 20, 33])
def test_the_rotation_between_two_visits_is_found(rng: np.random.Generator, sectors: int):
    points = place(rng)
    distance, yaw = descriptor_distances(
        spectrum_of(turned(points, sectors * SECTOR_RAD)), spectrum_of(points)[None], SETTINGS.sectors
    )
    assert distance[0] == pytest.approx(0.0, abs=1e-5)
    assert np.exp(1j * yaw[0]) == pytest.approx(np.exp(1j * sectors * SECTOR_RAD), abs=1e-5)


def test_any_rotation_is_found_to_a_sector(rng: np.random.Generator):
    points = place(rng)
    for angle in rng.uniform(-np.pi, np.pi, 20):
        _, yaw = descriptor_distances(spectrum_of(turned(points, angle)), spectrum_of(points)[None], SETTINGS.sectors)
        assert abs(np.angle(np.exp(1j * (yaw[0] - angle)))) <= SECTOR_RAD


def test_the_same_place_has_the_smallest_distance(rng: np.random.Generator):
    places = [place(rng) for _ in range(20)]
    others = np.stack([spectrum_of(points) for points in places])
    for k, points in enumerate(places):
        seen = turned(points, rng.uniform(-np.pi, np.pi)) + rng.normal(0.0, 0.05, points.shape)
        distances, _ = descriptor_distances(spectrum_of(seen), others, SETTINGS.sectors)
        assert distances.argmin() == k
        assert distances[k] < 0.85 * np.delete(distances, k).min()


def test_distances_are_between_0_and_1_and_symmetric(rng: np.random.Generator):
    spectra = np.stack([spectrum_of(place(rng)) for _ in range(6)])
    table = np.array([descriptor_distances(one, spectra, SETTINGS.sectors)[0] for one in spectra])
    assert (table > -1e-6).all()
    assert (table <= 1.0).all()
    np.testing.assert_allclose(table, table.T, atol=1e-5)


def test_the_descriptor_does_not_depend_on_the_mounting_height(rng: np.random.Generator):
    points = place(rng)
    np.testing.assert_allclose(
        place_descriptor(points + np.array([0.0, 0.0, 2.5]), SETTINGS), place_descriptor(points, SETTINGS), atol=1e-6
    )


def test_an_empty_descriptor_has_distance_1_and_far_points_are_left_out(rng: np.random.Generator):
    empty = place_descriptor(np.empty((0, 3)), SETTINGS)
    assert not empty.any()
    distance, _ = descriptor_distances(descriptor_spectrum(empty), spectrum_of(place(rng))[None], SETTINGS.sectors)
    assert distance[0] == pytest.approx(1.0)
    assert not place_descriptor(np.array([[41.0, 0.0, 3.0]]), SETTINGS).any()
