"""Halls: a warehouse with racks, and a parking garage."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from hybridlio.core.arrays import Array
from hybridlio.simulation.platforms.scenes.building import door, lamps, wall
from hybridlio.simulation.platforms.scenes.scene import Scene
from hybridlio.simulation.world import street
from hybridlio.simulation.world.shapes import Mesh, boxes, merge

# Pallet racks: bays of 2.7 m, levels of 1.8 m, 1.1 m deep, aisles for lift trucks: usual sizes of makers.
_BAY_M, _LEVEL_M, _RACK_M, _AISLE_M, _LEVELS = 2.7, 1.8, 1.1, 3.2, 4
_HALL_M = 9.5  # height
# A parking level: bays of 2.5 by 5 m on both sides of lanes of 6 m, a column every third bay, 2.6 m high.
_PARKING_BAY_M, _PARKING_DEPTH_M, _LANE_M, _DECK_M = 2.5, 5.0, 6.0, 2.6
_STEEL, _CARDBOARD, _CONCRETE = 0.45, 0.4, 0.4


def warehouse(rng: np.random.Generator, _length_m: float) -> Scene:
    """Build a warehouse; the way winds through the aisles between racks, and back along the wall."""
    bays, aisles = int(rng.integers(9, 15)), int(rng.choice([4, 6]))
    length, pitch, head = bays * _BAY_M, _AISLE_M + 2 * _RACK_M, 4.0
    width = aisles * pitch + 4.0
    corner, far = np.array([-head, -4.0]), np.array([length + head, width])
    parts = [_hall(corner, far, _HALL_M, rng)]
    parts += [
        _rack(bays, rng).placed(0.0, y, 0.0, 0.0)
        for k in range(aisles)
        for y in (k * pitch, k * pitch + _RACK_M + _AISLE_M)
    ]
    parts += [_pallet(rng).placed(x, width - 1.2, 0.0, 0.0) for x in rng.uniform(0, length, 8)]
    middle = _RACK_M + _AISLE_M / 2 + np.arange(aisles) * pitch
    ends = np.array([-head / 2, length + head / 2])
    turns = [(ends[(k + side) % 2], y) for k, y in enumerate(middle) for side in (0, 1)]
    way = [(ends[0], -2.0), *turns, (ends[0], -2.0)]
    return Scene(merge(parts), np.column_stack([np.array(way), np.zeros(len(way))]), True, _HALL_M - 1.0, 3.0)


def _rack(bays: int, rng: np.random.Generator) -> Mesh:
    """Return a rack along x from the origin, its back at y = 0, with pallets in most places."""
    x, z = np.arange(bays + 1) * _BAY_M, np.arange(1, _LEVELS) * _LEVEL_M
    uprights = [_upright_boxes(x, y, (0.1, 0.08), _LEVELS * _LEVEL_M, _STEEL) for y in (0.04, _RACK_M - 0.04)]
    beams = [
        boxes(
            np.column_stack([0 * z, 0 * z + y, z - 0.12]), np.column_stack([0 * z + x[-1], 0 * z + y + 0.05, z]), _STEEL
        )
        for y in (0.0, _RACK_M - 0.05)
    ]
    bay, level = (a.ravel() for a in np.meshgrid(np.arange(bays), np.arange(_LEVELS), indexing="ij"))
    full, count = rng.random(len(bay)) < 0.75, len(bay)
    low = np.column_stack([bay * _BAY_M, 0 * bay, level * _LEVEL_M + 0.02])
    low += rng.uniform([0.1, 0.0, 0.0], [0.5, 0.2, 1e-9], (count, 3))
    size = rng.uniform([0.9, 0.7, 0.5], [2.1, 0.9, 1.5], (count, 3))
    return merge([*uprights, *beams, boxes(low[full], (low + size)[full], _CARDBOARD)])


def _upright_boxes(x: ArrayLike, y: float, size_m: tuple[float, float], height_m: float, reflectance: float) -> Mesh:
    """Return posts that stand at ``x`` ``(N,)`` and ``y``, of a size along x and y."""
    x = np.asarray(x, dtype=np.float64)
    low = np.column_stack([x - size_m[0] / 2, 0 * x + y - size_m[1] / 2, 0 * x])
    return boxes(low, low + np.array([*size_m, height_m]), reflectance)


def _pallet(rng: np.random.Generator) -> Mesh:
    return boxes((-0.6, -0.4, 0.0), (0.6, 0.4, rng.uniform(0.2, 1.8)), _CARDBOARD)


def _hall(low: Array, high: Array, height_m: float, rng: np.random.Generator) -> Mesh:
    """Return floor, walls with doors, roof and beams of a hall between corners ``(2,)``."""
    slabs = boxes([[*low, -0.2], [*low, height_m]], [[*high, 0.0], [*high, height_m + 0.2]], _CONCRETE)
    (x0, y0), (x1, y1) = low, high
    gate = door(float(x1 - x0) * rng.uniform(0.2, 0.8), 3.0)
    walls = [
        wall((x0, y0), (x1, y0), 0.0, height_m, [gate]),
        wall((x0, y1), (x1, y1), 0.0, height_m, [door(4.0)]),
        wall((x0, y0), (x0, y1), 0.0, height_m),
        wall((x1, y0), (x1, y1), 0.0, height_m, [door(6.0)]),
    ]
    at = np.arange(x0 + 2.5, x1, 5.0)
    beams = boxes(
        np.column_stack([at - 0.15, 0 * at + y0, 0 * at + height_m - 0.3 * height_m / 3]),
        np.column_stack([at + 0.15, 0 * at + y1, 0 * at + height_m]),
        _CONCRETE,
    )
    outside = boxes((x0 - 40, y0 - 40, -0.5), (x1 + 40, y1 + 40, -0.2), 0.3)
    return merge([slabs, *walls, beams, lamps(low, high, height_m, rng), outside])


def garage(rng: np.random.Generator, _length_m: float) -> Scene:
    """Build a level of a parking garage; the way is the ring of lanes between parked cars and columns."""
    bays = int(rng.integers(14, 24))
    length, width = bays * _PARKING_BAY_M, 4 * _PARKING_DEPTH_M + 2 * _LANE_M
    low, high = np.array([-_LANE_M, 0.0]), np.array([length + _LANE_M, width])
    parts = [_hall(low, high, _DECK_M, rng)]
    rows = [0.0, _PARKING_DEPTH_M + _LANE_M, 2 * _PARKING_DEPTH_M + _LANE_M, 3 * _PARKING_DEPTH_M + 2 * _LANE_M]
    for y in rows:
        x = (np.arange(bays) + 0.5) * _PARKING_BAY_M
        for middle in x[rng.random(bays) < 0.6]:
            car = _low_car(rng)
            yaw = rng.choice([-1.0, 1.0]) * np.pi / 2 + rng.uniform(-0.04, 0.04)
            parts.append(car.placed(middle + rng.uniform(-0.15, 0.15), y + _PARKING_DEPTH_M / 2, 0.0, yaw))
        column = np.arange(0, bays + 1, 3) * _PARKING_BAY_M
        edge = y + (_PARKING_DEPTH_M - 0.5 if y in (rows[0], rows[2]) else 0.1)
        parts.append(_upright_boxes(column, edge + 0.2, (0.4, 0.4), _DECK_M, _CONCRETE))
    near, far = _PARKING_DEPTH_M + _LANE_M / 2, 3 * _PARKING_DEPTH_M + 1.5 * _LANE_M
    ends = (-_LANE_M / 2, length + _LANE_M / 2)
    way = np.array([(ends[0], near, 0), (ends[1], near, 0), (ends[1], far, 0), (ends[0], far, 0), (ends[0], near, 0)])
    return Scene(merge(parts), way.astype(np.float64), True, _DECK_M - 0.3, 4.0)


def _low_car(rng: np.random.Generator) -> Mesh:
    """Return a car that fits below the ceiling and into a bay."""
    while True:
        car = street.car(rng)
        if car.vertices[:, 2].max() < 2.0 and np.ptp(car.vertices[:, 0]) < 4.9:
            return car
