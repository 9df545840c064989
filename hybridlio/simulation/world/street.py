"""Objects along a street: houses, cars, trees, hedges, poles, signs, fences. Each is a mesh at the origin, z up.

Sizes are those of common objects in a European town, drawn within plausible ranges and checked by eye on rendered
scans; they do not follow a standard. Reflectances are those of dull surfaces at 905 nm, from 0.08 (rubber) to 0.6
(light plaster), and 0.95 for the retroreflecting plates of signs.
"""

from __future__ import annotations

import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.simulation.world.shapes import Mesh, boxes, cylinder, facets, merge, prism

_FOUNDATION_M = 2.0  # objects extend this far below their origin, so that none floats above uneven ground


def facade(width: float, height: float, recess: float, rng: np.random.Generator) -> Mesh:
    """Return a front at x from 0 to ``width`` and y from 0 to ``recess``: piers and bands around recessed windows."""
    storey = rng.uniform(2.7, 3.3)
    floors = max(int(height / storey), 1)
    axes = max(int(width / rng.uniform(2.2, 3.6)), 1)
    sill, lintel, share = rng.uniform(0.7, 1.0), rng.uniform(2.2, 2.5), rng.uniform(0.35, 0.6)
    shade = rng.uniform(0.25, 0.65)
    bottoms = np.arange(floors) * storey
    edges = np.concatenate([[-_FOUNDATION_M], bottoms[1:] + lintel - storey])
    bands = boxes(
        np.column_stack([np.zeros(floors), np.zeros(floors), edges]),
        np.column_stack([np.full(floors, width), np.full(floors, recess), bottoms + sill]),
        shade,
    )
    top = boxes((0.0, 0.0, bottoms[-1] + lintel), (width, recess, height), shade)
    bay = width / axes
    left = np.concatenate([[0.0], (np.arange(axes) + (1 + share) / 2) * bay])
    right = np.concatenate([(np.arange(axes) + (1 - share) / 2) * bay, [width]])
    x0, z0 = np.repeat(left, floors), np.tile(bottoms + sill, axes + 1)
    x1, z1 = np.repeat(right, floors), np.tile(bottoms + lintel, axes + 1)
    piers = boxes(np.column_stack([x0, 0 * x0, z0]), np.column_stack([x1, 0 * x1 + recess, z1]), shade)
    door = boxes((width * 0.45, -0.6, -_FOUNDATION_M), (width * 0.45 + 1.6, 0.0, 0.18), 0.35)
    return merge([bands, top, piers, door])


def _balconies(width: float, height: float, rng: np.random.Generator) -> Mesh:
    x = rng.uniform(0.5, max(width - 4.0, 0.6))
    levels = np.arange(2.9, height - 2.0, 2.9)
    if not len(levels):
        return Mesh.empty()
    low = np.column_stack([0 * levels + x, 0 * levels - 1.1, levels])
    slab = boxes(low, low + np.array([3.0, 1.1, 0.15]), 0.45)
    rail = boxes(low + np.array([0.0, 0.0, 0.15]), low + np.array([3.0, 0.05, 1.0]), 0.4)
    return merge([slab, rail])


def house(width: float, depth: float, height: float, detached: bool, rng: np.random.Generator) -> Mesh:
    """Return a house, centred in x, front at y = 0 facing -y; some have balconies, a gabled roof, a chimney."""
    recess = rng.uniform(0.12, 0.35)
    core = boxes(
        (recess, recess, -_FOUNDATION_M), (width - recess, depth - recess, height - 0.02), rng.uniform(0.1, 0.3)
    )
    parts = [core, facade(width, height, recess, rng)]
    if rng.random() < 0.35:
        parts.append(_balconies(width, height, rng))
    sides = facade(depth, height, recess, rng)
    parts += [sides.placed(width, 0.0, 0.0, np.pi / 2), sides.placed(0.0, depth, 0.0, -np.pi / 2)]
    parts.append(boxes((0.0, depth - recess, -_FOUNDATION_M), (width, depth, height), 0.4))
    parts.append(_roof(width, depth, height, detached, rng))
    return merge(parts).moved([-width / 2, 0.0, 0.0])


def _roof(width: float, depth: float, height: float, detached: bool, rng: np.random.Generator) -> Mesh:
    if rng.random() < 0.3:
        return boxes((0.0, -0.1, height), (width, depth, height + rng.uniform(0.2, 0.9)), 0.3)
    over, rise = rng.uniform(0.2, 0.6), depth / 2 * np.tan(np.radians(rng.uniform(25, 45)))
    gable = prism([(-over, height), (depth + over, height), (depth / 2, height + rise)], 0.0, width, 0.3)
    # the profile of a prism is in x and z; rotated, it is in y and z
    roof = gable.placed(width, 0.0, 0.0, np.pi / 2)
    x = rng.uniform(1.0, width - 1.6)
    chimney = boxes((x, depth * 0.4, height), (x + 0.6, depth * 0.4 + 0.6, height + rise + 0.6), 0.35)
    return merge([roof, chimney]) if detached or rng.random() < 0.5 else roof


def car(rng: np.random.Generator) -> Mesh:
    """Return a car, van or lorry of random size and paint, centred on the origin, x forward."""
    paint = rng.uniform(0.08, 0.7)
    kind = rng.random()
    length, width, height = rng.uniform(3.8, 4.8), rng.uniform(1.68, 1.85), rng.uniform(1.42, 1.65)
    if kind > 0.94:
        return _lorry(rng.uniform(6.5, 9.0), paint)
    front, back = length / 2, -length / 2
    waist = height * 0.62
    hood = rng.uniform(0.9, 1.25)
    if kind > 0.8:  # a van
        height, hood, waist = rng.uniform(1.9, 2.4), 0.6, 1.1
    body = [
        (back, 0.25),
        (front, 0.25),
        (front, 0.68),
        (front - 0.35, waist * 0.88),
        (front - hood, waist),
        (back, waist),
    ]
    tail = rng.uniform(0.05, 0.7) if kind <= 0.8 else 0.03
    cabin = [(back + 0.02, waist), (front - hood + 0.05, waist), (front - hood - 0.75, height), (back + tail, height)]
    wheels = [
        prism(_octagon(x, 0.31), y, y + 0.2, 0.08)
        for x in (front - 0.8, back + 0.75)
        for y in (-width / 2, width / 2 - 0.2)
    ]
    mirrors = boxes([[front - 1.6, -width / 2 - 0.15, 0.95]], [[front - 1.45, width / 2 + 0.15, 1.08]], paint)
    shell = [
        prism(body, -width / 2, width / 2, paint, 0.06),
        prism(cabin, -width / 2 + 0.06, width / 2 - 0.06, 0.18, 0.12),
    ]
    return merge([*shell, *wheels, mirrors])


def _octagon(x: float, radius: float) -> list[tuple[float, float]]:
    angle = np.arange(8) * np.pi / 4
    return [(x + radius * np.cos(a), radius + radius * np.sin(a)) for a in angle]


def _lorry(length: float, paint: float) -> Mesh:
    front = length / 2
    cabin = boxes((front - 1.9, -1.15, 0.45), (front, 1.15, 2.7), paint)
    box = boxes((-front, -1.22, 0.9), (front - 2.1, 1.22, 3.4), 0.5)
    wheels = [prism(_octagon(x, 0.45), y, y + 0.3, 0.08) for x in (front - 1.2, -front + 1.5) for y in (-1.2, 0.9)]
    return merge([cabin, box, *wheels])


def tree(rng: np.random.Generator) -> Mesh:
    """Return a tree: a trunk, and a crown of clustered facets."""
    trunk, radius = rng.uniform(1.8, 3.2), rng.uniform(0.09, 0.28)
    crown_radius, crown_height = rng.uniform(1.3, 3.2), rng.uniform(2.5, 6.0)
    count = int(220 * min(crown_radius, 2.5))
    clusters = _in_ball(rng, 14) * [crown_radius, crown_radius, crown_height / 2]
    clusters[:, 2] += trunk + crown_height / 2
    leaves = clusters[rng.integers(len(clusters), size=count)] + _in_ball(rng, count) * crown_radius * 0.55
    leaves[:, 2] = np.maximum(leaves[:, 2], trunk * 0.8)
    top = trunk + crown_height * 0.5
    stem = cylinder(radius, radius * 0.5, -_FOUNDATION_M, top, rng.uniform(0.2, 0.4), 7)
    return merge([stem, facets(leaves, rng.uniform(0.09, 0.16), 0.38, rng)])


def bush(length: float, height: float, rng: np.random.Generator) -> Mesh:
    """Return a bush, or a piece of hedge ``length`` metres along x: facets around a smaller solid core."""
    count = int(60 + 55 * length * height)
    spread = rng.uniform(-0.5, 0.5, (count, 3)) * [length, 0.7, 1.0]
    spread[:, 2] = rng.uniform(0.05, 1.0, count) * height
    core = boxes((-length * 0.42, -0.18, -_FOUNDATION_M), (length * 0.42, 0.18, height * 0.75), 0.3)
    return merge([core, facets(spread, 0.09, 0.38, rng)])


def grass_tuft(rng: np.random.Generator) -> Mesh:
    """Return knee-high growth on open land."""
    count = int(rng.integers(15, 60))
    spot = rng.normal(0.0, rng.uniform(0.3, 1.0), (count, 3))
    spot[:, 2] = rng.uniform(0.0, rng.uniform(0.2, 0.7), count)
    return facets(spot, 0.08, 0.42, rng)


def pole(rng: np.random.Generator) -> Mesh:
    """Return a lamp post with an arm, or a plain mast."""
    height, radius = rng.uniform(4.5, 8.0), rng.uniform(0.06, 0.13)
    post = cylinder(radius, radius * 0.7, -_FOUNDATION_M, height, 0.5, 8)
    if rng.random() < 0.5:
        return post
    return merge([post, boxes((-0.06, 0.0, height - 0.15), (0.06, 1.6, height), 0.5)])


def sign(rng: np.random.Generator) -> Mesh:
    """Return a traffic sign on a post, facing -x."""
    height, size = rng.uniform(2.0, 2.6), rng.uniform(0.5, 0.9)
    post = cylinder(0.03, 0.03, -_FOUNDATION_M, height + size / 2, 0.5, 6)
    plate = boxes((-0.06, -size / 2, height - size / 2), (-0.04, size / 2, height + size / 2), 0.95)
    return merge([post, plate])


def fence(style: str, length: float, height: float, rng: np.random.Generator) -> Mesh:
    """Return a piece of fence along x, centred; ``style`` is ``wall``, ``picket`` or ``rail``."""
    half, shade = length / 2, rng.uniform(0.3, 0.5)
    if style == "wall":
        return boxes((-half, -0.12, -_FOUNDATION_M), (half, 0.12, height), shade)
    post = boxes((-half - 0.05, -0.05, -_FOUNDATION_M), (-half + 0.05, 0.05, height + 0.1), shade)
    rails = boxes(
        [[-half, -0.02, 0.25 * height], [-half, -0.02, 0.8 * height]],
        [[half, 0.02, 0.25 * height + 0.08], [half, 0.02, 0.8 * height + 0.08]],
        shade,
    )
    if style == "rail":
        return merge([post, rails])
    x = np.arange(-half + 0.1, half - 0.1, 0.2)
    low = np.column_stack([x, 0 * x - 0.035, 0 * x + 0.08])
    return merge([post, rails, boxes(low, low + np.array([0.09, 0.015, height - 0.08]), shade)])


def _in_ball(rng: np.random.Generator, count: int) -> Array:
    """Draw ``(count, 3)`` points uniformly from the unit ball."""
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return np.asarray(direction * np.cbrt(rng.random((count, 1))))
