"""A house: four furnished rooms and a hall on each of two floors, and a straight staircase between them."""

from __future__ import annotations

import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.simulation.platforms.scenes.building import door, flight, furnish, lamps, wall, windows
from hybridlio.simulation.platforms.scenes.scene import Scene
from hybridlio.simulation.world.shapes import Mesh, boxes, merge

_STEPS, _RISE_M, _GOING_M = 16, 0.175, 0.26
_STOREY_M = _STEPS * _RISE_M
_SLAB_M = 0.2
_HALL_M = 2.1  # width; the staircase takes its northern half
_STAIR_X_M = 2.0  # where the staircase arrives
_MARGIN_M = 0.3

_Room = tuple[Array, Array, float, bool]
_Point = tuple[float, float, float]


class _Plan:
    """Sizes of a house: x from 0 to ``length``, the hall from ``south`` to ``south + _HALL_M``."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.length, self.split = rng.uniform(9.5, 11.5), rng.uniform(4.6, 5.2)
        self.south, self.north = rng.uniform(3.2, 4.5), rng.uniform(3.2, 4.5)
        self.stair_low = _STAIR_X_M + _STEPS * _GOING_M
        self.upper = self.south + _HALL_M
        self.width = self.upper + self.north
        self.walk, self.stair_y = self.south + 0.5, self.upper - 0.5
        self.doors_south = (self.split / 2, (self.split + self.length) / 2)
        self.doors_north = (0.8, self.length - 1.2)

    def rooms(self) -> list[_Room]:
        """Return the rooms: corners ``(2,)``, the place of the door along x, and whether it is in the south wall."""
        out = []
        for k, (left, right) in enumerate(((0.0, self.split), (self.split, self.length))):
            out.append((np.array([left, 0.0]), np.array([right, self.south]), self.doors_south[k], True))
            out.append((np.array([left, self.upper]), np.array([right, self.width]), self.doors_north[k], False))
        return out


def house(rng: np.random.Generator, _length_m: float) -> Scene:
    """Build a house; the way visits all rooms, upstairs too, and comes back."""
    plan = _Plan(rng)
    way = _way(plan)
    parts = [_street(plan), flight((plan.stair_low, plan.stair_y, 0.0), np.pi, 0.9, _RISE_M, _GOING_M, _STEPS, rng)]
    for level in (0, 1):
        z = level * _STOREY_M
        parts += _storey(plan, z, rng)
        for low, high, _, _ in plan.rooms():
            parts.append(furnish(low, high, z, way, _MARGIN_M, rng))
            parts.append(lamps(low, high, z + _STOREY_M - _SLAB_M, rng))
    return Scene(merge(parts), way, True, _STOREY_M - _SLAB_M)


def _way(plan: _Plan) -> Array:
    """Return the way through all rooms of both floors and back."""
    up: list[_Point] = [(plan.length - 0.8, plan.walk, 0.0)]
    visits = plan.rooms()
    for index in (2, 3, 0, 1):
        up += _visit(plan, 0.0, visits[index])
    foot, top = plan.stair_low, _STAIR_X_M
    up += [(foot + 0.7, plan.walk, 0.0), (foot + 0.7, plan.stair_y, 0.0), (foot, plan.stair_y, 0.0)]
    up += [(top, plan.stair_y, _STOREY_M), (top - 0.9, plan.stair_y, _STOREY_M), (top - 0.9, plan.walk, _STOREY_M)]
    for index in (1, 0, 2, 3):
        up += _visit(plan, _STOREY_M, visits[index])
    return np.array(up + up[::-1])


def _visit(plan: _Plan, z: float, room: _Room) -> list[_Point]:
    """Return a way from the hall through a door, around the room, and back."""
    low, high, at, is_south = room
    edge, inside = (plan.south, -1.0) if is_south else (plan.upper, 1.0)
    (x0, y0), (x1, y1) = low + 1.1, high - 1.1
    near, far = (y1, y0) if is_south else (y0, y1)
    first, last = (x0, x1) if at < (x0 + x1) / 2 else (x1, x0)
    around = [(first, near), (first, far), (last, far), (last, near)]
    points = [(at, plan.walk), (at, edge + 0.9 * inside), *around, (at, edge + 1.0 * inside), (at, plan.walk)]
    return [(float(x), float(y), z) for x, y in points]


def _storey(plan: _Plan, z: float, rng: np.random.Generator) -> list[Mesh]:
    """Return the walls, and the slab above."""
    height = _STOREY_M - _SLAB_M
    parts = [
        wall((0.0, 0.0), (plan.length, 0.0), z, height, windows(plan.length, rng)),
        wall((0.0, plan.width), (plan.length, plan.width), z, height, windows(plan.length, rng)),
        wall((0.0, 0.0), (0.0, plan.width), z, height, windows(plan.width, rng)),
        wall((plan.length, 0.0), (plan.length, plan.width), z, height, [(0.8, 2.2, 0.9, 2.1)]),
        wall((0.0, plan.south), (plan.length, plan.south), z, height, [door(x) for x in plan.doors_south]),
        wall((0.0, plan.upper), (plan.length, plan.upper), z, height, [door(x) for x in plan.doors_north]),
        wall((plan.split, 0.0), (plan.split, plan.south), z, height),
        wall((plan.split, plan.upper), (plan.split, plan.width), z, height),
    ]
    hole_y = plan.upper - 1.0
    low, high = z + height, z + _STOREY_M
    if z > 0:
        return [*parts, boxes((0.0, 0.0, low), (plan.length, plan.width, high), 0.5)]
    pieces = [
        ((0.0, 0.0), (plan.length, hole_y)),
        ((0.0, plan.upper), (plan.length, plan.width)),
        ((0.0, hole_y), (_STAIR_X_M, plan.upper)),
        ((plan.stair_low, hole_y), (plan.length, plan.upper)),
    ]
    return [*parts, *(boxes((*a, low), (*b, high), 0.5) for a, b in pieces)]


def _street(plan: _Plan) -> Mesh:
    """Return the ground, and houses across the street."""
    ground = boxes((-40.0, -40.0, -0.3), (plan.length + 40, plan.width + 40, 0.0), 0.35)
    low, high = [[-10.0, -22.0, 0.0], [-8.0, plan.width + 16, 0.0]], [[14.0, -14.0, 8.0], [12.0, plan.width + 24, 7.0]]
    across = boxes(low, high, 0.45)
    return merge([ground, across])
