"""Where things stand along the road: a town in stretches of different character, a walled corridor, an open field."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from scipy.spatial import cKDTree

from hybridlio.core.arrays import Array
from hybridlio.simulation.config import SimulationConfig
from hybridlio.simulation.world import street
from hybridlio.simulation.world.ground import CURB_OFFSET_M, SIDEWALK_END_M
from hybridlio.simulation.world.roads import Road
from hybridlio.simulation.world.shapes import Mesh

Build = Callable[[np.random.Generator], Mesh]

_ALREADY_DRESSED_M = 6.0


@dataclass(frozen=True, eq=False)
class Item:
    """A thing in the world: ``build`` makes its mesh when it is first in sight."""

    x: float
    y: float
    yaw: float
    radius: float
    build: Build


@dataclass(eq=False)
class Layout:
    """Things placed so far, each clear of the road and of the houses before it."""

    road: Road
    centre: cKDTree
    rng: np.random.Generator
    items: list[Item] = field(default_factory=list)
    _houses: list[tuple[float, float, float]] = field(default_factory=list)

    def place(self, s: float, left_m: float, yaw: float, radius: float, build: Build, clear_m: float) -> bool:
        """Put a thing beside the road, turned by ``yaw`` from the road's heading, unless something is in the way.

        ``clear_m`` is the distance its outline of ``radius`` must keep from every centreline.
        """
        at, heading = self._at(s, left_m)
        if self.centre.query(at)[0] < clear_m + radius - 1e-6 or self._in_a_house(at, radius):
            return False
        self.items.append(Item(float(at[0]), float(at[1]), heading + yaw, radius, build))
        return True

    def place_house(self, s: float, left_m: float, width: float, depth: float, height: float, detached: bool) -> bool:
        """Put a house with its front ``left_m`` from the centreline, facing the road."""
        side = 1.0 if left_m > 0 else -1.0
        front, heading = self._at(s, left_m)
        yaw = heading if side > 0 else heading + np.pi
        c, sn = np.cos(yaw), np.sin(yaw)
        u, v = np.meshgrid(np.linspace(-width / 2, width / 2, 6), np.linspace(0.0, depth, 5))
        outline = front + np.column_stack([c * u.ravel() - sn * v.ravel(), sn * u.ravel() + c * v.ravel()])
        if self.centre.query(outline)[0].min() < min(abs(left_m), SIDEWALK_END_M) - 0.05:
            return False
        middle, radius = outline.mean(axis=0), float(min(width, depth) / 2)
        if any((middle[0] - x) ** 2 + (middle[1] - y) ** 2 < (0.95 * (r + radius)) ** 2 for x, y, r in self._houses):
            return False
        self._houses.append((float(middle[0]), float(middle[1]), radius))
        build = partial(street.house, width, depth, height, detached)
        self.items.append(Item(float(front[0]), float(front[1]), float(yaw), 0.0, build))
        return True

    def _at(self, s: float, left_m: float) -> tuple[Array, float]:
        where = np.array([s])
        return self.road.beside(where, left_m)[0], float(self.road.heading(where)[0])

    def _in_a_house(self, at: Array, radius: float) -> bool:
        near = np.array(self._houses[-60:]).reshape(-1, 3)
        return bool((np.hypot(near[:, 0] - at[0], near[:, 1] - at[1]) < near[:, 2] * 1.15 + radius * 0.6).any())


def lay_out(road: Road, centre: cKDTree, config: SimulationConfig, rng: np.random.Generator) -> list[Item]:
    """Everything that stands along the road. Streets driven twice are furnished once."""
    layout = Layout(road, centre, rng)
    if config.scene == "corridor":
        _corridor(layout)
    elif config.scene == "field":
        _field(layout)
    else:
        fresh = _fresh(road)
        s = 0.0
        while s < road.length_m:
            length = rng.uniform(45.0, 140.0)
            for side in (1.0, -1.0):
                kind = rng.choice(["row", "detached", "park", "open"], p=[0.4, 0.32, 0.14, 0.14])
                _stretch(layout, fresh, s, min(s + length, road.length_m), side, str(kind), config.parked)
            s += length
    return layout.items


def _fresh(road: Road) -> Callable[[float], bool]:
    """Whether the road at ``s`` is not one driven earlier."""
    s = np.arange(0.0, road.length_m + 2.0, 2.0)
    points = road.at(np.minimum(s, road.length_m))
    pairs = cKDTree(points).query_pairs(_ALREADY_DRESSED_M, output_type="ndarray")
    again = np.zeros(len(s), dtype=bool)
    again[pairs[pairs[:, 1] - pairs[:, 0] > 20, 1]] = True
    return lambda at: not again[min(int(at / 2.0), len(again) - 1)]


def _stretch(
    layout: Layout, fresh: Callable[[float], bool], start: float, end: float, side: float, kind: str, parked: float
) -> None:
    """One side of a stretch of street."""
    rng = layout.rng
    fittings: list[tuple[Callable[[Layout, float, float], None], float, float]] = [
        (_lamp, 22.0, 40.0),
        (_sign, 25.0, 90.0),
    ]
    if kind in ("row", "detached") and parked > 0:
        fittings.append((partial(_parked_car, chance=parked), 5.2, 7.5))
    if rng.random() < 0.45:
        fittings.append((_street_tree, 8.0, 16.0))
    if kind == "row":
        setback = rng.uniform(SIDEWALK_END_M + 0.3, 9.5)
        _houses(layout, fresh, start, end, side, setback, (0.0, 3.0), (8.0, 17.0), (6.0, 14.0), False)
    elif kind == "detached":
        setback = rng.uniform(11.0, 16.0)
        style = str(rng.choice(["wall", "picket", "rail", "hedge"]))
        fittings += [(partial(_fence, style=style), 2.4, 2.4), (_garden, 5.0, 14.0)]
        _houses(layout, fresh, start, end, side, setback, (4.0, 12.0), (8.0, 13.0), (4.0, 8.5), True)
    else:
        fittings.append((_park if kind == "park" else _meadow, 2.5, 6.0))
    for fit, shortest, longest in fittings:
        s = start + rng.uniform(0.0, shortest)
        while s < end:
            if fresh(s):
                fit(layout, s, side)
            s += rng.uniform(shortest, longest)


def _houses(
    layout: Layout,
    fresh: Callable[[float], bool],
    start: float,
    end: float,
    side: float,
    setback: float,
    gap: tuple[float, float],
    widths: tuple[float, float],
    heights: tuple[float, float],
    detached: bool,
) -> None:
    rng = layout.rng
    s, eaves = start, rng.uniform(*heights)
    while s < end:
        width, depth = rng.uniform(*widths), rng.uniform(8.0, 12.0)
        if fresh(s + width / 2) and s + width < layout.road.length_m and rng.random() < 0.93:
            high = float(np.clip(eaves + rng.normal(0, 1.2), *heights))
            front = setback + (rng.uniform(-0.5, 2.0) if detached else rng.choice([0.0, 0.0, 0.4]))
            layout.place_house(s + width / 2, side * front, width, depth, high, detached)
            if rng.random() < 0.5:
                back = setback + rng.uniform(24.0, 45.0)
                layout.place_house(
                    s, side * back, rng.uniform(9, 18), rng.uniform(8, 12), high + rng.uniform(-1, 3), True
                )
        s += width + (rng.uniform(*gap) if detached or rng.random() < 0.3 else 0.0)


def _lamp(layout: Layout, s: float, side: float) -> None:
    yaw = np.pi if side > 0 else 0.0
    layout.place(s, side * (CURB_OFFSET_M + 0.5), yaw, 0.1, street.pole, CURB_OFFSET_M + 0.2)


def _sign(layout: Layout, s: float, side: float) -> None:
    yaw = 0.0 if side < 0 else np.pi
    layout.place(s, side * (CURB_OFFSET_M + 0.6), yaw, 0.1, street.sign, CURB_OFFSET_M + 0.2)


def _parked_car(layout: Layout, s: float, side: float, chance: float) -> None:
    rng = layout.rng
    if rng.random() < chance:
        yaw = (0.0 if side < 0 else np.pi) + rng.normal(0.0, 0.03)
        layout.place(s, side * (CURB_OFFSET_M - 1.05 + rng.normal(0, 0.08)), yaw, 0.9, street.car, 3.3)


def _street_tree(layout: Layout, s: float, side: float) -> None:
    layout.place(s, side * (CURB_OFFSET_M + 0.9), layout.rng.uniform(0, 6), 0.3, street.tree, CURB_OFFSET_M + 0.2)


def _fence(layout: Layout, s: float, side: float, style: str) -> None:
    if layout.rng.random() < 0.06:
        return  # a gate
    at = side * (SIDEWALK_END_M + 0.3)
    build: Build
    if style == "hedge":
        build = partial(street.bush, 2.4, 1.4)
    else:
        height = 1.1 if style != "wall" else 1.5
        build = partial(street.fence, style, 2.4, height)
    layout.place(s, at, 0.0, 0.1, build, SIDEWALK_END_M - 0.3)


def _garden(layout: Layout, s: float, side: float) -> None:
    rng = layout.rng
    left = side * rng.uniform(SIDEWALK_END_M + 1.5, 28.0)
    if rng.random() < 0.55:
        layout.place(s, left, rng.uniform(0, 6), 1.0, street.tree, SIDEWALK_END_M - 0.5)
    else:
        build = partial(street.bush, rng.uniform(0.8, 3.0), rng.uniform(0.6, 2.0))
        layout.place(s, left, rng.uniform(0, 6), 1.0, build, SIDEWALK_END_M - 0.5)


def _park(layout: Layout, s: float, side: float) -> None:
    rng = layout.rng
    left = side * (SIDEWALK_END_M + 1.5 + rng.exponential(12.0))
    if rng.random() < 0.6:
        layout.place(s, left, rng.uniform(0, 6), 0.8, street.tree, SIDEWALK_END_M)
    else:
        build = partial(street.bush, rng.uniform(1.0, 4.0), rng.uniform(0.5, 2.2))
        layout.place(s, left, rng.uniform(0, 6), 0.8, build, SIDEWALK_END_M)


def _meadow(layout: Layout, s: float, side: float) -> None:
    rng = layout.rng
    build = street.grass_tuft if rng.random() < 0.9 else street.tree
    layout.place(
        s, side * (SIDEWALK_END_M + 1.0 + rng.exponential(14.0)), rng.uniform(0, 6), 0.5, build, SIDEWALK_END_M
    )


def _corridor(layout: Layout) -> None:
    """Smooth walls on both sides, with a lamp post now and then."""
    for side in (1.0, -1.0):
        for s in np.arange(2.0, layout.road.length_m - 2.0, 4.0):
            layout.place(float(s), side * 8.5, 0.0, 0.1, partial(street.fence, "wall", 4.06, 4.5), 7.0)
        for s in np.arange(30.0, layout.road.length_m, 120.0):
            _lamp(layout, float(s), side)


def _field(layout: Layout) -> None:
    """A tree or a bush every thirty metres or so, most of them far from the road."""
    rng = layout.rng
    s = 0.0
    while s < layout.road.length_m:
        left = rng.choice([-1.0, 1.0]) * rng.uniform(15.0, 70.0)
        build = (
            street.tree if rng.random() < 0.5 else partial(street.bush, rng.uniform(1.0, 4.0), rng.uniform(0.8, 2.0))
        )
        layout.place(s, left, rng.uniform(0, 6), 1.0, build, 10.0)
        for _ in range(6):
            _meadow(layout, s + rng.uniform(0, 20), float(rng.choice([-1.0, 1.0])))
        s += rng.uniform(15.0, 45.0)
