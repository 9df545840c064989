"""A campus: large buildings around lawns, with paths, trees, lamp posts, hedges and benches."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.simulation.platforms.scenes.land import Plot, terrain
from hybridlio.simulation.platforms.scenes.scene import Scene, clearance
from hybridlio.simulation.world import street
from hybridlio.simulation.world.ground import waves
from hybridlio.simulation.world.shapes import Mesh, boxes, merge

_MARGIN_M = 60.0  # of ground around the way
_BUILDINGS, _TREES, _POLES, _BUSHES, _BENCHES = 18, 70, 25, 40, 15  # tried on a campus; some find no place


def _loop(rng: np.random.Generator, size_m: Array) -> Array:
    """Return corners ``(N, 2)`` of an irregular closed path around the origin."""
    angle = np.arange(9) * 2 * np.pi / 9 + rng.uniform(-0.2, 0.2, 9)
    corners = np.column_stack([np.cos(angle), np.sin(angle)]) * size_m * rng.uniform(0.6, 1.0, (9, 1))
    return np.concatenate([corners, corners[:1]])


def campus(rng: np.random.Generator, _length_m: float) -> Scene:
    """Build a campus; the way is a closed loop of 200 to 350 m."""
    way = _loop(rng, rng.uniform([40.0, 30.0], [60.0, 45.0]))
    hills, bumps = waves(rng, 6, (60.0, 200.0), 0.02), waves(rng, 24, (1.5, 8.0), 0.02)

    def height(xy: Array) -> Array:
        return hills(xy) + bumps(xy)

    low, high = way.min(axis=0) - _MARGIN_M, way.max(axis=0) + _MARGIN_M
    plot = Plot(low + 30, high - 30, way, height)
    parts = [terrain(height, low, high, 1.0), *_buildings(plot, rng)]
    parts += plot.scatter(street.tree, _TREES, 4.0, 1.4, rng)
    parts += plot.scatter(street.pole, _POLES, 1.2, 0.3, rng)
    parts += plot.scatter(_bench, _BENCHES, 1.5, 1.0, rng)
    parts += plot.scatter(lambda r: street.bush(r.uniform(1.0, 4.0), r.uniform(0.6, 1.6), r), _BUSHES, 3.0, 1.0, rng)
    line = np.concatenate([np.linspace(a, b, 20, endpoint=False) for a, b in pairwise(way)])
    line = np.concatenate([line, way[:1]])
    return Scene(merge(parts), np.column_stack([line, height(line)]), True)


def _bench(rng: np.random.Generator) -> Mesh:
    top = boxes([[-0.9, -0.2, 0.42], [-0.9, 0.18, 0.55]], [[0.9, 0.2, 0.46], [0.9, 0.22, 0.9]], rng.uniform(0.3, 0.5))
    return merge([top, boxes([[-0.8, -0.15, -0.5], [0.7, -0.15, -0.5]], [[-0.7, 0.15, 0.42], [0.8, 0.15, 0.42]], 0.4)])


def _buildings(plot: Plot, rng: np.random.Generator) -> list[Mesh]:
    """Return buildings beside the way, their fronts towards it."""
    way = plot.way
    parts: list[Mesh] = []
    for _ in range(_BUILDINGS * 6):
        if len(parts) >= _BUILDINGS:
            break
        segment = int(rng.integers(len(way) - 1))
        along = way[segment + 1] - way[segment]
        normal = np.array([-along[1], along[0]]) / np.linalg.norm(along) * rng.choice([-1.0, 1.0])
        width, depth = rng.uniform(12.0, 30.0), rng.uniform(9.0, 15.0)
        front = way[segment] + rng.random() * along + normal * rng.uniform(5.0, 22.0)
        centre, radius = front + normal * depth / 2, float(np.hypot(width, depth)) / 2
        yaw = float(np.arctan2(normal[1], normal[0]) - np.pi / 2)
        corners = _rectangle(front, yaw, width, depth)
        if clearance(corners, way).min() < 4.0 or not plot.is_free(centre, radius):
            continue
        plot.taken.append((centre, radius))
        mesh = street.house(width, depth, rng.uniform(6.0, 18.0), True, rng)
        parts.append(mesh.placed(front[0], front[1], plot.height(front[None])[0], yaw))
    return parts


def _rectangle(front: Array, yaw: float, width: float, depth: float) -> Array:
    """Return points ``(P, 2)`` all over a building's footprint, two metres apart."""
    x, y = np.meshgrid(np.arange(-width / 2, width / 2 + 2, 2.0), np.arange(0.0, depth + 2, 2.0))
    c, s = np.cos(yaw), np.sin(yaw)
    return np.asarray(np.column_stack([x.ravel(), y.ravel()]) @ np.array([[c, s], [-s, c]]) + front)
