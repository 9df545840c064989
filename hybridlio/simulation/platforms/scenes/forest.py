"""A forest: uneven ground, trunks a few metres apart, crowns, undergrowth and boulders."""

from __future__ import annotations

import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.simulation.platforms.scenes.land import terrain
from hybridlio.simulation.platforms.scenes.scene import Scene, clearance
from hybridlio.simulation.world import street
from hybridlio.simulation.world.ground import waves
from hybridlio.simulation.world.shapes import Mesh, cylinder, facets, merge

_SPACING_M = 3.4  # of trunks: 860 on a hectare, a managed forest
_AROUND_M = 45.0  # of forest beside the way; farther trunks are hidden
_PATH_M = 1.3  # kept free on either side


def forest(rng: np.random.Generator, _length_m: float) -> Scene:
    """Build a forest; the way is a closed path between the trees."""
    angle = np.linspace(0.0, 2 * np.pi, 100)
    bent = 1.0 + 0.25 * np.sin(3 * angle + rng.uniform(0, 6)) + 0.12 * np.sin(7 * angle + rng.uniform(0, 6))
    flat = np.column_stack([np.cos(angle), np.sin(angle)]) * bent[:, None] * rng.uniform([32.0, 22.0], [42.0, 32.0])
    hills, bumps = waves(rng, 8, (40.0, 150.0), 0.07), waves(rng, 32, (0.8, 6.0), 0.05)

    def height(xy: Array) -> Array:
        return hills(xy) + bumps(xy)

    low, high = flat.min(axis=0) - _AROUND_M, flat.max(axis=0) + _AROUND_M
    parts = [terrain(height, low, high, 0.8)]
    for build, spacing, margin in ((_tree, _SPACING_M, _PATH_M), (_growth, 5.5, 1.0), (_boulder, 9.0, 1.6)):
        spots = _grid(low, high, spacing, rng)
        apart = clearance(spots, flat)
        spots = spots[(apart > margin) & (apart < 0.8 * _AROUND_M)]
        for spot, z in zip(spots, height(spots), strict=True):
            parts.append(build(rng).placed(spot[0], spot[1], z, rng.uniform(-np.pi, np.pi)))
    return Scene(merge(parts), np.column_stack([flat, height(flat)]), True, 2.2)


def _grid(low: Array, high: Array, spacing_m: float, rng: np.random.Generator) -> Array:
    """Return points of a grid that are moved at random, so that none stand closely."""
    axes = [np.arange(a, b, spacing_m) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    return np.asarray(points + rng.uniform(-0.42, 0.42, points.shape) * spacing_m)


def _tree(rng: np.random.Generator) -> Mesh:
    """Return a tall tree: a bare trunk, dead twigs, and a crown."""
    height, radius = rng.uniform(9.0, 18.0), rng.uniform(0.08, 0.28)
    lean = rng.normal(0.0, 0.02, 2)
    trunk = cylinder(radius, 0.3 * radius, -1.0, height, rng.uniform(0.2, 0.4), 7)
    trunk = Mesh(trunk.vertices + np.outer(trunk.vertices[:, 2], [*lean, 0.0]), trunk.triangles, trunk.reflectance)
    share = rng.random(90)
    spread = (1.05 - share) * rng.uniform(1.5, 3.0)
    side = rng.uniform(0, 2 * np.pi, len(share))
    at = np.column_stack([np.cos(side) * spread, np.sin(side) * spread, (0.35 + 0.65 * share) * height])
    return merge([trunk, facets(at, 0.22, 0.38, rng)])


def _growth(rng: np.random.Generator) -> Mesh:
    return street.bush(rng.uniform(0.4, 1.5), rng.uniform(0.3, 1.1), rng)


def _boulder(rng: np.random.Generator) -> Mesh:
    size = rng.uniform(0.3, 0.9)
    return cylinder(size, 0.5 * size, -0.5, size * rng.uniform(0.4, 1.0), 0.35, 6)
