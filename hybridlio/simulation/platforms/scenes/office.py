"""An office floor: a ring of corridors, rooms of 4 to 8 m on both sides, doors, furniture and windows."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.simulation.platforms.scenes.building import DOOR_M, cabinet, door, furnish, lamps, wall, windows
from hybridlio.simulation.platforms.scenes.scene import Scene
from hybridlio.simulation.world.shapes import Mesh, boxes, merge

_CEILING_M, _CORRIDOR_M = 2.8, 2.2
_MARGIN_M = 0.4  # between the way and furniture: a person's half width, and a little
_BELOW_M = 7.0  # the street lies two storeys below


def _splits(length_m: float, rng: np.random.Generator) -> Array:
    """Divide a length into rooms of 4 to 8 m; return the borders."""
    count = max(round(length_m / 6.0), 1)
    widths = rng.uniform(4.5, 7.5, count)
    return np.concatenate([[0.0], np.cumsum(widths / widths.sum() * length_m)])


class _Floor:
    """An office floor under construction. The ring of corridors is ``length_m`` by ``width_m`` on its middle lines."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.length_m, self.width_m = rng.uniform(22.0, 32.0), rng.uniform(10.0, 15.0)
        self.depth_m = rng.uniform(4.0, 7.0, 2)
        self.parts: list[Mesh] = []
        self.rooms: list[tuple[Array, Array]] = []
        self.way: list[tuple[float, float]] = []

    def side(self, y: float, towards: float, depth_m: float, outer: bool) -> list[tuple[float, list[Array]]]:
        """Build the rooms on one side of a corridor along x; return detours into some, with where they start."""
        half = _CORRIDOR_M / 2
        low_x = -half if outer else half
        near, length = y + towards * half, self.length_m - 2 * low_x
        borders = _splits(length, self.rng)
        far = near + towards * depth_m
        detours, doors = [], []
        for left, right in pairwise(borders):
            at = self.rng.uniform(left + 1.5, right - 0.9)
            doors.append(door(at))
            a, b = (low_x + left, min(near, far)), (low_x + right, max(near, far))
            self.rooms.append((np.array(a), np.array(b)))
            self.parts.append(self._leaf(low_x + at, near, towards))
            if self.rng.random() < 0.45:
                detours.append((low_x + at, self._visit(low_x + at, y, near, towards, np.array([a, b]))))
        self.parts.append(wall((low_x, near), (low_x + length, near), 0.0, _CEILING_M, doors))
        openings = windows(length, self.rng) if outer else []
        self.parts.append(wall((low_x, far), (low_x + length, far), 0.0, _CEILING_M, openings))
        self.parts += [wall((low_x + x, near), (low_x + x, far), 0.0, _CEILING_M) for x in borders]
        return detours

    def _leaf(self, x: float, y: float, towards: float) -> Mesh:
        leaf = boxes((0.0, -0.02, 0.0), (DOOR_M - 0.1, 0.02, 2.05), 0.4)
        return leaf.placed(x - DOOR_M / 2 - 0.05, y + towards * 0.1, 0.0, towards * self.rng.uniform(2.8, 3.1))

    def _visit(self, x: float, y: float, near: float, towards: float, room: Array) -> list[Array]:
        """Return a way from the corridor through a door, around the middle of a room, and back."""
        middle, size = room.mean(axis=0), np.ptp(room, axis=0)
        inside = np.array([x, near + towards * 1.3])
        reach = np.maximum(size / 2 - 1.3, 0.3)
        turn = self.rng.choice([-1.0, 1.0])
        corners = [
            middle + reach * np.array(c)
            for c in ((turn, -towards), (turn, towards), (-turn, towards), (-turn, -towards))
        ]
        return [np.array([x, y]), inside, *corners, inside, np.array([x, y])]


def office(rng: np.random.Generator, _length_m: float) -> Scene:
    """Build an office floor; the way follows the ring of corridors and visits rooms."""
    floor = _Floor(rng)
    core = (floor.width_m - _CORRIDOR_M) / 2
    south = floor.side(0.0, -1.0, floor.depth_m[0], True) + floor.side(0.0, 1.0, core, False)
    north = floor.side(floor.width_m, 1.0, floor.depth_m[1], True) + floor.side(floor.width_m, -1.0, core, False)
    way = [np.array([0.0, 0.0])]
    for _, visit in sorted(south, key=lambda d: d[0]):
        way += visit
    way += [np.array([floor.length_m, 0.0]), np.array([floor.length_m, floor.width_m])]
    for _, visit in sorted(north, key=lambda d: -d[0]):
        way += visit
    way += [np.array([0.0, floor.width_m]), np.array([0.0, 0.0])]
    line = np.column_stack([np.array(way), np.zeros(len(way))])
    parts = [*floor.parts, *_shell(floor, rng)]
    for low, high in floor.rooms:
        parts += [furnish(low, high, 0.0, line, _MARGIN_M, rng), lamps(low, high, _CEILING_M, rng)]
    parts += [_in_corridors(floor, rng)]
    return Scene(merge(parts), line, True, _CEILING_M)


def _shell(floor: _Floor, rng: np.random.Generator) -> list[Mesh]:
    """Return floor, ceiling, the ends of the corridors, and what is seen through the windows."""
    half = _CORRIDOR_M / 2
    low = np.array([-half, -half - floor.depth_m[0]])
    high = np.array([floor.length_m + half, floor.width_m + half + floor.depth_m[1]])
    slabs = boxes([[*low, -0.3], [*low, _CEILING_M]], [[*high, 0.0], [*high, _CEILING_M + 0.3]], 0.45)
    ends = [
        wall((x, -half), (x, floor.width_m + half), 0.0, _CEILING_M, windows(floor.width_m + 2 * half, rng))
        for x in (low[0], high[0])
    ]
    street = boxes((low[0] - 60, low[1] - 60, -_BELOW_M - 0.5), (high[0] + 60, high[1] + 60, -_BELOW_M), 0.3)
    across = [
        boxes((low[0] - 5, y - 5, -_BELOW_M), (high[0] + 5, y + 5, rng.uniform(3.0, 15.0)), 0.4)
        for y in (low[1] - rng.uniform(18, 30), high[1] + rng.uniform(18, 30))
    ]
    return [slabs, *ends, street, *across]


def _in_corridors(floor: _Floor, rng: np.random.Generator) -> Mesh:
    """Return cupboards along the corridors and lamps over them."""
    half = _CORRIDOR_M / 2
    parts = [lamps((0.0, y - 0.5), (floor.length_m, y + 0.5), _CEILING_M, rng) for y in (0.0, floor.width_m)]
    for x, yaw in ((0.1 - half, np.pi / 2), (floor.length_m + half - 0.1, -np.pi / 2)):
        parts += [cabinet(rng).placed(x, y, 0.0, yaw) for y in rng.uniform(1.5, floor.width_m - 1.5, 2)]
    return merge(parts)
