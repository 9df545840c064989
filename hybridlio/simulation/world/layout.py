"""Where objects stand along the road: in a town of varied stretches, a walled corridor, or an open field.

Spacings, setbacks and chances are plausible for a European town; they were chosen by eye on rendered scans.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.spatial import cKDTree

from hybridlio.simulation.choices import Scene
from hybridlio.simulation.world import street
from hybridlio.simulation.world.ground import CURB_OFFSET_M, SIDEWALK_END_M
from hybridlio.simulation.world.items import Build, Item
from hybridlio.simulation.world.parking import park_again, parked_car
from hybridlio.simulation.world.placing import Layout
from hybridlio.simulation.world.roads import Road

_SAME_STREET_M = 6.0  # a point nearer than this to an earlier piece of the route is on the same street
_SAMPLE_M = 2.0  # distance of the points at which the route is searched for streets driven before


@dataclass(frozen=True, eq=False)
class _Stretch:
    """One side of a stretch of street.

    Attributes:
        start, end: arc lengths on the centreline.
        side: 1 on the left, -1 on the right.
        is_first: returns whether the route is on its street for the first time at an arc length.
    """

    start: float
    end: float
    side: float
    is_first: Callable[[float], bool]


@dataclass(frozen=True)
class _HouseStyle:
    """Ranges of houses in metres: gaps between them, widths, and heights of the eaves."""

    detached: bool
    gaps: tuple[float, float]
    widths: tuple[float, float]
    heights: tuple[float, float]


# Plausible for a town: rows of two to four storeys, whose gaps are often closed; houses with gardens are lower.
_ROW_HOUSES = _HouseStyle(detached=False, gaps=(0.0, 3.0), widths=(8.0, 17.0), heights=(6.0, 14.0))
_DETACHED_HOUSES = _HouseStyle(detached=True, gaps=(4.0, 12.0), widths=(8.0, 13.0), heights=(4.0, 8.5))


def lay_out(
    road: Road,
    centre: cKDTree,
    scene: Scene,
    parked: float,
    rng: np.random.Generator,
    again: np.random.Generator | None = None,
) -> list[Item]:
    """Place all objects along the road. Streets that the route passes twice are furnished once.

    Args:
        road: the route's centreline.
        centre: k-d tree of points on the centreline.
        scene: kind of surroundings.
        parked: share of parking places that are taken.
        rng: decides what stands where.
        again: decides which cars are parked otherwise, at another drive through the town; None at the first.
    """
    layout = Layout(road, centre, rng)
    if scene == "corridor":
        _corridor(layout)
    elif scene == "field":
        _field(layout)
    else:
        is_first = _first_visits(road)
        s = 0.0
        while s < road.length_m:
            length = rng.uniform(45.0, 140.0)
            for side in (1.0, -1.0):
                kind = rng.choice(["row", "detached", "park", "open"], p=[0.4, 0.32, 0.14, 0.14])
                _furnish(layout, _Stretch(s, min(s + length, road.length_m), side, is_first), str(kind), parked)
            s += length
    if again is not None:
        park_again(layout, parked, again)
    return layout.items


def _first_visits(road: Road) -> Callable[[float], bool]:
    """Return a function of arc length: whether the route is on that street for the first time."""
    s = np.arange(0.0, road.length_m + _SAMPLE_M, _SAMPLE_M)
    points = road.at(np.minimum(s, road.length_m))
    pairs = cKDTree(points).query_pairs(_SAME_STREET_M, output_type="ndarray")
    again = np.zeros(len(s), dtype=bool)
    again[pairs[pairs[:, 1] - pairs[:, 0] > 20, 1]] = True  # neighbours along the road are not visits
    return lambda at: not again[min(int(at / _SAMPLE_M), len(again) - 1)]


def _furnish(layout: Layout, stretch: _Stretch, kind: str, parked: float) -> None:
    """Furnish one side of a stretch of street; ``kind`` is ``row``, ``detached``, ``park`` or ``open``."""
    rng = layout.rng
    fittings: list[tuple[Callable[[Layout, float, float], None], float, float]] = [
        (_lamp, 22.0, 40.0),
        (_sign, 25.0, 90.0),
    ]
    if kind in ("row", "detached") and parked > 0:
        fittings.append((partial(parked_car, chance=parked), 5.2, 7.5))
    if rng.random() < 0.45:
        fittings.append((_street_tree, 8.0, 16.0))
    if kind == "row":
        setback = rng.uniform(SIDEWALK_END_M + 0.3, 9.5)
        _houses(layout, stretch, setback, _ROW_HOUSES)
    elif kind == "detached":
        setback = rng.uniform(11.0, 16.0)
        style = str(rng.choice(["wall", "picket", "rail", "hedge"]))
        fittings += [(partial(_fence, style=style), 2.4, 2.4), (_garden, 5.0, 14.0)]
        _houses(layout, stretch, setback, _DETACHED_HOUSES)
    else:
        fittings.append((_park if kind == "park" else _meadow, 2.5, 6.0))
    for fit, shortest, longest in fittings:
        s = stretch.start + rng.uniform(0.0, shortest)
        while s < stretch.end:
            if stretch.is_first(s):
                fit(layout, s, stretch.side)
            s += rng.uniform(shortest, longest)


def _houses(layout: Layout, stretch: _Stretch, setback: float, style: _HouseStyle) -> None:
    """Place houses with fronts about ``setback`` metres from the centreline, and some in a second row behind."""
    rng, side = layout.rng, stretch.side
    s, eaves = stretch.start, rng.uniform(*style.heights)
    while s < stretch.end:
        width, depth = rng.uniform(*style.widths), rng.uniform(8.0, 12.0)
        if stretch.is_first(s + width / 2) and s + width < layout.road.length_m and rng.random() < 0.93:
            high = float(np.clip(eaves + rng.normal(0, 1.2), *style.heights))
            front = setback + (rng.uniform(-0.5, 2.0) if style.detached else rng.choice([0.0, 0.0, 0.4]))
            layout.place_house(s + width / 2, side * front, width, depth, high, style.detached)
            if rng.random() < 0.5:
                back = setback + rng.uniform(24.0, 45.0)
                layout.place_house(
                    s, side * back, rng.uniform(9, 18), rng.uniform(8, 12), high + rng.uniform(-1, 3), True
                )
        s += width + (rng.uniform(*style.gaps) if style.detached or rng.random() < 0.3 else 0.0)


def _lamp(layout: Layout, s: float, side: float) -> None:
    yaw = np.pi if side > 0 else 0.0
    layout.place(s, side * (CURB_OFFSET_M + 0.5), yaw, 0.1, street.pole, CURB_OFFSET_M + 0.2)


def _sign(layout: Layout, s: float, side: float) -> None:
    yaw = 0.0 if side < 0 else np.pi
    layout.place(s, side * (CURB_OFFSET_M + 0.6), yaw, 0.1, street.sign, CURB_OFFSET_M + 0.2)


def _street_tree(layout: Layout, s: float, side: float) -> None:
    layout.place(s, side * (CURB_OFFSET_M + 0.9), layout.rng.uniform(0, 6), 0.3, street.tree, CURB_OFFSET_M + 0.2)


def _fence(layout: Layout, s: float, side: float, style: str) -> None:
    if layout.rng.random() < 0.06:
        return  # leave a gate
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
    """Place smooth walls on both sides, and a lamp post every 120 m."""
    for side in (1.0, -1.0):
        for s in np.arange(2.0, layout.road.length_m - 2.0, 4.0):
            layout.place(float(s), side * 8.5, 0.0, 0.1, partial(street.fence, "wall", 4.06, 4.5), 7.0)
        for s in np.arange(30.0, layout.road.length_m, 120.0):
            _lamp(layout, float(s), side)


def _field(layout: Layout) -> None:
    """Place a tree or a bush about every 30 m, mostly far from the road, and grass between."""
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
