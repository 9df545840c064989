"""Planes through neighbours: normal, width and weight by thickness, and rings of one beam."""

import numpy as np
import pytest

from hybridlio.cloud.normals import estimate_normals
from hybridlio.cloud.plane_fitting import fit_planes, span_several_rings


def slab(rng: np.random.Generator, thickness_m: float, count: int = 4000) -> np.ndarray:
    """A group of points ``(1, N, 3)`` on a plane tilted about x, with this root mean square distance from it."""
    flat = np.column_stack(
        [rng.uniform(-3, 3, count), rng.uniform(-1, 1, count), thickness_m * rng.standard_normal(count)]
    )
    c, s = np.cos(0.3), np.sin(0.3)
    return (flat @ np.array([[1, 0, 0], [0, c, s], [0, -s, c]]))[None]


def test_the_normal_is_the_direction_of_least_variance_and_the_width_that_of_the_next(rng: np.random.Generator):
    planes = fit_planes(slab(rng, 0.01))
    np.testing.assert_allclose(np.abs(planes.normals[0]), [0, np.sin(0.3), np.cos(0.3)], atol=2e-3)
    assert planes.width_m[0] == pytest.approx(1 / np.sqrt(3), rel=0.05)


@pytest.mark.parametrize(
    ("thickness_m", "least", "most"),
    [(0.02, 0.95, 1.0), (0.05, 0.8, 0.95), (0.5, 0.0, 0.2)],
    ids=["road", "rough ground", "hedge"],
)
def test_a_lidars_noise_keeps_the_weight_and_a_hedge_loses_it(
    rng: np.random.Generator, thickness_m: float, least: float, most: float
):
    weight = fit_planes(slab(rng, thickness_m)).weights[0]
    assert least <= weight <= most


@pytest.mark.parametrize(("places", "has_normals"), [(4, False), (8, True)])
def test_a_plane_needs_more_points_than_it_has_unknowns(rng: np.random.Generator, places: int, has_normals: bool):
    points = np.column_stack([rng.uniform(4, 5, (places, 2)), np.ones(places)])
    assert estimate_normals(points, neighbours=5, thin_m=0.0).any() == has_normals


def ring(elevation_deg: float, jitter_deg: float = 0.0, count: int = 10) -> np.ndarray:
    """Points of one beam on a wall ahead."""
    azimuth = np.linspace(-0.05, 0.05, count)
    elevation = np.radians(elevation_deg + jitter_deg * np.sin(7 * np.arange(count)))
    level = 20.0 / np.cos(azimuth)
    return np.column_stack([level * np.cos(azimuth), level * np.sin(azimuth), level * np.tan(elevation)])


@pytest.mark.parametrize(
    ("rings", "several"),
    [
        ([ring(2.0, 0.03)], False),
        ([ring(2.0, count=5), ring(2.4, count=5)], True),
        ([ring(2.0, count=9), ring(2.4, count=1)], False),
        ([ring(2.0, count=7), ring(2.4, count=3)], True),
    ],
    ids=["jitter of a beam", "beams 0.4° apart", "one stray point", "three of ten"],
)
def test_rings_are_distinguished_by_their_elevation(rings: list[np.ndarray], several: bool):
    points = np.concatenate(rings)
    assert span_several_rings(points, np.arange(10, dtype=np.uint64)[None])[0] == several
