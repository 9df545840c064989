"""A single furnished room with a door and windows, in which a person walks round."""

from __future__ import annotations

import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.simulation.platforms.scenes.building import DOOR_HEIGHT_M, DOOR_M, furnish, lamps, wall, windows
from hybridlio.simulation.platforms.scenes.scene import Scene
from hybridlio.simulation.world.shapes import boxes, merge

_LENGTH_M, _WIDTH_M, _CEILING_M = (4.5, 5.5), (3.6, 4.4), 2.6  # an ordinary living room or office
_AISLE_M = 1.3  # between the walls and the way, for furniture
_MARGIN_M = 0.3
_STREET_M = 8.0  # to the house on its other side, which is seen through the windows
_DOOR_LEAF = 0.4  # reflectance: wood


def room(rng: np.random.Generator, _length_m: float) -> Scene:
    """Build a room of about 5 by 4 m; the way goes round its middle."""
    length, width = rng.uniform(*_LENGTH_M), rng.uniform(*_WIDTH_M)
    low, high = np.zeros(2), np.array([length, width])
    way = _way(low + _AISLE_M, high - _AISLE_M)
    at = rng.uniform(0.7, width - 0.7)
    parts = [
        boxes([[0, 0, -0.2], [0, 0, _CEILING_M]], [[length, width, 0.0], [length, width, _CEILING_M + 0.2]], 0.5),
        wall((0.0, 0.0), (length, 0.0), 0.0, _CEILING_M),
        wall((0.0, width), (length, width), 0.0, _CEILING_M, windows(length, rng)),
        wall((0.0, 0.0), (0.0, width), 0.0, _CEILING_M),
        wall((length, 0.0), (length, width), 0.0, _CEILING_M),
        boxes((0.08, at - DOOR_M / 2, 0.0), (0.12, at + DOOR_M / 2, DOOR_HEIGHT_M), _DOOR_LEAF),
        boxes((-20.0, width + _STREET_M, -5.0), (length + 20.0, width + _STREET_M + 5.0, rng.uniform(4.0, 12.0)), 0.4),
        furnish(low, high, 0.0, way, _MARGIN_M, rng),
        lamps(low, high, _CEILING_M, rng),
    ]
    return Scene(merge(parts), way, True, _CEILING_M)


def _way(low: Array, high: Array) -> np.ndarray:
    """Return a closed rectangle on the floor between two corners ``(2,)``."""
    (x, y), (u, v) = low, high
    return np.array([[x, y, 0.0], [u, y, 0.0], [u, v, 0.0], [x, v, 0.0], [x, y, 0.0]])
