"""Parts of buildings: walls with openings, slabs, stairs, and furniture.

Sizes are those of common offices and homes (desks of 0.72 m, doors of 0.95 by 2.1 m, risers of 17 cm); they do not
follow one standard. Reflectances are those of dull surfaces at 905 nm: plaster 0.6, wood 0.4, dark plastic 0.15.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from hybridlio.core.arrays import Array
from hybridlio.simulation.platforms.scenes.scene import clearance
from hybridlio.simulation.world.shapes import Mesh, boxes, cylinder, facets, merge

DOOR_M, DOOR_HEIGHT_M = 1.0, 2.1
_WALL_M = 0.15  # thickness of a partition
_PLASTER, _WOOD, _METAL, _DARK = 0.6, 0.4, 0.5, 0.15
_TRIES = 40  # places that are tried for a piece of furniture before it is left out

Opening = tuple[float, float, float, float]  # start and end along the wall, and heights of its bottom and top, metres


def door(middle_m: float, width_m: float = DOOR_M) -> Opening:
    """Return the opening of a door around a point of a wall."""
    return (middle_m - width_m / 2, middle_m + width_m / 2, 0.0, DOOR_HEIGHT_M)


def wall(start: ArrayLike, end: ArrayLike, low_m: float, height_m: float, openings: Sequence[Opening] = ()) -> Mesh:
    """Return a wall between two points ``(2,)`` with openings, which do not overlap.

    Args:
        start, end: on the middle line of the wall.
        low_m: height of its foot.
        height_m: from foot to top.
        openings: through which a lidar sees.
    """
    start, end = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    length, half = float(np.linalg.norm(end - start)), _WALL_M / 2
    parts, at = [], 0.0
    for left, right, bottom, top in [*sorted(openings), (length, length, 0.0, height_m)]:
        parts.append(((at, -half, 0.0), (left, half, height_m)))
        parts.append(((left, -half, 0.0), (right, half, bottom)))
        parts.append(((left, -half, top), (right, half, height_m)))
        at = right
    solid = [(low, high) for low, high in parts if min(np.subtract(high, low)) > 1e-6]
    low, high = np.array(solid).transpose(1, 0, 2)
    along = end - start
    return boxes(low, high, _PLASTER).placed(start[0], start[1], low_m, np.arctan2(along[1], along[0]))


def windows(length_m: float, rng: np.random.Generator) -> list[Opening]:
    """Return a row of windows along a wall; glass returns nothing."""
    count, width = int(length_m / 3.0), rng.uniform(1.0, 1.8)
    middles = (np.arange(count) + 0.5) * length_m / max(count, 1)
    return [(float(m - width / 2), float(m + width / 2), 0.9, 2.2) for m in middles]


def desk(rng: np.random.Generator) -> Mesh:
    """Return a desk with a screen and a chair, its back edge at y = 0."""
    width, depth = rng.uniform(1.2, 1.8), rng.uniform(0.6, 0.8)
    top = boxes((-width / 2, -depth, 0.70), (width / 2, 0.0, 0.73), _WOOD)
    x, y = np.array([-1, 1, -1, 1]) * (width / 2 - 0.06), np.array([-0.06, -0.06, 0.06 - depth, 0.06 - depth])
    legs = boxes(
        np.column_stack([x - 0.03, y - 0.03, 0 * x]), np.column_stack([x + 0.03, y + 0.03, 0 * x + 0.7]), _METAL
    )
    at = rng.uniform(-0.3, 0.3)
    screen = boxes(
        [[at - 0.3, -0.22, 0.85], [at - 0.04, -0.2, 0.73]], [[at + 0.3, -0.18, 1.2], [at + 0.04, -0.16, 0.85]], _DARK
    )
    seat = chair(rng).placed(at, -depth - 0.25, 0.0, rng.uniform(-0.6, 0.6))
    return merge([top, legs, screen, seat])


def chair(rng: np.random.Generator) -> Mesh:
    """Return a chair on the origin, its back towards -y."""
    shade = rng.uniform(0.15, 0.5)
    seat = boxes([[-0.23, -0.23, 0.42], [-0.22, -0.26, 0.55]], [[0.23, 0.23, 0.47], [0.22, -0.22, 0.95]], shade)
    foot = boxes([[-0.3, -0.03, 0.03], [-0.03, -0.3, 0.03]], [[0.3, 0.03, 0.08], [0.03, 0.3, 0.08]], _DARK)
    return merge([seat, foot, cylinder(0.03, 0.03, 0.05, 0.42, _DARK, 6)])


def cabinet(rng: np.random.Generator) -> Mesh:
    """Return a cupboard or an open shelf, its back at y = 0."""
    width, depth, height = rng.uniform(0.6, 1.4), rng.uniform(0.3, 0.5), rng.uniform(0.8, 2.1)
    if rng.random() < 0.5:
        return boxes((-width / 2, -depth, 0.0), (width / 2, 0.0, height), _WOOD)
    levels = np.arange(0.05, height, 0.35)
    boards = boxes(
        np.column_stack([0 * levels - width / 2, 0 * levels - depth, levels]),
        np.column_stack([0 * levels + width / 2, 0 * levels, levels + 0.025]),
        _WOOD,
    )
    sides = boxes(
        [[-width / 2, -depth, 0], [width / 2 - 0.02, -depth, 0]],
        [[-width / 2 + 0.02, 0, height], [width / 2, 0, height]],
        _WOOD,
    )
    x = rng.uniform(-width / 2, width / 2 - 0.15, len(levels))
    books = boxes(
        np.column_stack([x, 0 * x - depth * 0.8, levels]),
        np.column_stack([x + 0.15, 0 * x - 0.05, levels + 0.25]),
        0.35,
    )
    return merge([boards, sides, books])


def plant(rng: np.random.Generator) -> Mesh:
    """Return a potted plant on the origin."""
    leaves = rng.normal(0.0, 0.18, (60, 3)) + np.array([0.0, 0.0, rng.uniform(0.8, 1.3)])
    return merge(
        [cylinder(0.15, 0.2, 0.0, 0.4, 0.3), cylinder(0.03, 0.02, 0.4, 0.9, 0.3, 6), facets(leaves, 0.06, 0.4, rng)]
    )


def lamps(low: ArrayLike, high: ArrayLike, ceiling_m: float, rng: np.random.Generator) -> Mesh:
    """Return lamps below the ceiling of a room between corners ``low`` and ``high`` ``(2,)``."""
    low, high = np.asarray(low), np.asarray(high)
    count = np.maximum(((high - low) / rng.uniform(1.8, 3.0)).astype(int), 1)
    grid = np.stack(np.meshgrid(*[(np.arange(n) + 0.5) / n for n in count], indexing="ij"), axis=-1).reshape(-1, 2)
    middle = low + grid * (high - low)
    size, drop = np.array([0.6, 0.1]), rng.uniform(0.06, 0.3)
    bottom = np.full(len(middle), ceiling_m - drop)
    return boxes(np.column_stack([middle - size, bottom]), np.column_stack([middle + size, bottom + 0.05]), _METAL)


def furnish(
    low: ArrayLike, high: ArrayLike, floor_m: float, way: Array, margin_m: float, rng: np.random.Generator
) -> Mesh:
    """Return furniture of a room between corners ``low`` and ``high`` ``(2,)``, along its walls and inside.

    No piece comes nearer to the way ``(N, 2+)`` than ``margin_m`` beyond its outline; one that finds no place is left
    out.
    """
    low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    near = way[(way[:, 2] > floor_m - 1.5) & (way[:, 2] < floor_m + 1.5)] if way.shape[1] > 2 else way
    way = near if len(near) > 1 else way
    placed: list[tuple[Array, float]] = []
    parts = []
    for _ in range(max(int(np.prod(high - low) / 2.5), 2)):
        build, radius = [(desk, 0.95), (cabinet, 0.7), (cabinet, 0.7), (chair, 0.35), (plant, 0.3)][rng.integers(5)]
        mesh = build(rng)
        for _ in range(_TRIES):
            spot, yaw = _place(low, high, build in (desk, cabinet), rng)
            free = all(np.linalg.norm(spot - other) > 0.8 * (radius + size) for other, size in placed)
            if free and clearance(_outline(mesh, spot, yaw), way).min() > margin_m:
                placed.append((spot, radius))
                parts.append(mesh.placed(float(spot[0]), float(spot[1]), floor_m, yaw))
                break
    return merge(parts)


def _outline(mesh: Mesh, spot: Array, yaw: float) -> Array:
    """Return points ``(9, 2)`` on the footprint of a placed mesh."""
    low, high = mesh.vertices[:, :2].min(axis=0), mesh.vertices[:, :2].max(axis=0)
    grid = np.array([[x, y] for x in (0.0, 0.5, 1.0) for y in (0.0, 0.5, 1.0)])
    c, s = np.cos(yaw), np.sin(yaw)
    return np.asarray((low + grid * (high - low)) @ np.array([[c, s], [-s, c]]) + spot)


def _place(low: Array, high: Array, at_wall: bool, rng: np.random.Generator) -> tuple[Array, float]:
    """Draw a place for a piece, and its yaw; one that stands at a wall has its back, +y, to it."""
    spot = rng.uniform(low + 0.6, np.maximum(high - 0.6, low + 0.61))
    if not at_wall or rng.random() < 0.15:
        return spot, float(rng.uniform(-np.pi, np.pi))
    gap = _WALL_M / 2 + 0.02
    side = int(rng.integers(4))
    axis, upper = side % 2, side >= 2
    spot[axis] = high[axis] - gap if upper else low[axis] + gap
    return spot, float([np.pi / 2, np.pi, -np.pi / 2, 0.0][side])


def flight(
    start: ArrayLike, yaw: float, width_m: float, rise_m: float, going_m: float, steps: int, rng: np.random.Generator
) -> Mesh:
    """Return a flight of stairs, which climbs from ``start`` ``(3,)`` along ``yaw``, with a railing on its left."""
    x, y, z = np.asarray(start, dtype=np.float64)
    i = np.arange(steps)
    low = np.column_stack([i * going_m, 0 * i - width_m / 2, (i + 1) * rise_m - 0.25])
    high = np.column_stack([(i + 1) * going_m + 0.02, 0 * i + width_m / 2, (i + 1) * rise_m])
    posts = np.column_stack([(i + 0.5) * going_m, 0 * i + width_m / 2 - 0.04, (i + 1) * rise_m])
    railing = boxes(posts - np.array([0.012, 0.012, 0.0]), posts + np.array([0.012, 0.012, 0.9]), _METAL)
    back, ahead = np.array([-going_m / 2, -0.02, 0.9]), np.array([going_m / 2, 0.02, 0.9 + rise_m])
    rail = boxes(posts + back, posts + ahead, _WOOD)
    return merge([boxes(low, high, rng.uniform(0.4, 0.6)), railing, rail]).placed(x, y, z, yaw)
