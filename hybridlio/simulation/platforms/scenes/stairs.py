"""A stairwell: flights and landings over several floors, with a small hall on each."""

from __future__ import annotations

import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.simulation.platforms.scenes.building import door, flight, furnish, lamps, wall
from hybridlio.simulation.platforms.scenes.scene import Scene
from hybridlio.simulation.world.shapes import Mesh, boxes, merge

_FLOORS = 5  # the ground floor and four above
_RISE_M, _GOING_M, _STEPS = 0.17, 0.28, 9  # of one flight; two flights make a storey of 3.06 m
_STOREY_M = 2 * _STEPS * _RISE_M
_FLIGHT_M, _LANDING_M, _GAP_M = 1.2, 1.3, 0.12
_MARGIN_M = 0.35
_HEADROOM_M = _STOREY_M - 0.25


def stairs(rng: np.random.Generator, _length_m: float) -> Scene:
    """Build a stairwell; the way climbs to the top floor, with visits to halls, and comes down again."""
    length, width = 2 * _LANDING_M + _STEPS * _GOING_M, 2 * _FLIGHT_M + _GAP_M
    hall = np.array([rng.uniform(3.5, 6.0), rng.uniform(3.0, 5.0)])
    visited = [bool(rng.random() < 0.5) for _ in range(_FLOORS)]
    way = _way(hall, visited)
    parts = [_shell(length, width)]
    for level in range(_FLOORS):
        parts += _storey(level, length, width, hall, rng)
        low, high = np.array([-hall[0], 0.0]), np.array([0.0, hall[1]])
        parts.append(furnish(low, high, level * _STOREY_M, way, _MARGIN_M, rng))
        parts.append(lamps(low, high, level * _STOREY_M + _STOREY_M - 0.2, rng))
    return Scene(merge(parts), way, True, _HEADROOM_M)


def _way(hall: Array, visited: list[bool]) -> Array:
    """Return the way up, with a turn in the halls that are visited, and down again."""
    y_up, y_down = _FLIGHT_M / 2, _FLIGHT_M * 1.5 + _GAP_M
    x_low, x_high = _LANDING_M, _LANDING_M + _STEPS * _GOING_M
    up: list[tuple[float, float, float]] = []
    for level, visit in enumerate(visited):
        z = level * _STOREY_M
        if visit or level in (0, len(visited) - 1):
            up += _turn_in(hall, z)
        if level == len(visited) - 1:
            break
        middle = z + _STOREY_M / 2
        up += [(x_low - 0.6, y_up, z), (x_low, y_up, z), (x_high, y_up, middle), (x_high + 0.65, y_up, middle)]
        up += [(x_high + 0.65, y_down, middle), (x_high, y_down, middle), (x_low, y_down, z + _STOREY_M)]
        up += [(x_low - 0.6, y_down, z + _STOREY_M)]
    return np.array(up + up[::-1])


def _turn_in(hall: Array, z: float) -> list[tuple[float, float, float]]:
    x, y = -hall[0] + 1.2, hall[1] - 1.2
    return [(0.5, 1.2, z), (-1.0, 1.2, z), (x, 1.0, z), (x, y, z), (-1.1, y, z), (-1.0, 1.3, z), (0.5, 1.3, z)]


def _shell(length: float, width: float) -> Mesh:
    """Return the walls of the stairwell over all floors, with windows at the middle landings."""
    top = _FLOORS * _STOREY_M
    openings = [
        (0.5, width - 0.5, (level + 0.5) * _STOREY_M + 1.0, (level + 0.5) * _STOREY_M + 1.9)
        for level in range(_FLOORS - 1)
    ]
    far = [wall((length, 0.0), (length, width), 0.0, top, [o]) for o in openings[:1]]
    sides = [wall((0.0, y), (length, y), 0.0, top) for y in (-0.075, width + 0.075)]
    roof = boxes((0.0, 0.0, top), (length, width, top + 0.2), 0.5)
    ground = boxes((0.0, 0.0, -0.2), (length, width, 0.0), 0.45)
    return merge([*far, *sides, roof, ground])


def _storey(level: int, length: float, width: float, hall: Array, rng: np.random.Generator) -> list[Mesh]:
    """Return flights, landings and the hall of one floor."""
    z, y_up, y_down = level * _STOREY_M, _FLIGHT_M / 2, _FLIGHT_M * 1.5 + _GAP_M
    x_low, x_high = _LANDING_M, _LANDING_M + _STEPS * _GOING_M
    hall_z = z + _STOREY_M - 0.2
    parts = [
        boxes(
            [[-hall[0], 0.0, z - 0.2], [-hall[0], 0.0, hall_z]], [[0.0, hall[1], z], [0.0, hall[1], hall_z + 0.01]], 0.5
        ),
        wall((0.0, 0.0), (0.0, max(width, hall[1])), z, _STOREY_M - 0.01, [door(1.25, 1.2)]),
        wall((-hall[0], 0.0), (-hall[0], hall[1]), z, _STOREY_M - 0.2, [door(hall[1] / 2)] if hall[1] > 2 else []),
        wall((-hall[0], 0.0), (0.0, 0.0), z, _STOREY_M - 0.2),
        wall((-hall[0], hall[1]), (0.0, hall[1]), z, _STOREY_M - 0.2, [(1.0, 2.2, 0.9, 2.2)]),
        boxes((0.0, 0.0, z - 0.2), (x_low, width, z), 0.5),
    ]
    if level < _FLOORS - 1:
        middle = z + _STOREY_M / 2
        parts += [
            flight((x_low, y_up, z), 0.0, _FLIGHT_M, _RISE_M, _GOING_M, _STEPS, rng),
            boxes((x_high, 0.0, middle - 0.2), (length, width, middle), 0.5),
            flight((x_high, y_down, middle), np.pi, _FLIGHT_M, _RISE_M, _GOING_M, _STEPS, rng),
        ]
    return parts
