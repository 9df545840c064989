"""Parked cars, and which of them come and go between two drives through a town."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hybridlio.simulation.world import street
from hybridlio.simulation.world.ground import CURB_OFFSET_M
from hybridlio.simulation.world.placing import Layout

_CAR_CLEARANCE_M = 3.3  # from every centreline to a parked car, which may reach 0.2 m into the lane
# Parked cars that stay between two drives through a town. Judgement: hours apart, most are gone.
_STAYING_SHARE = 0.3
_PARKED_AGAIN_SIGMA_M = 0.3  # along the kerb, of where the next car stands in a place
_NEW_CARS = 1_000_000  # numbers of their shapes begin here, above those of a town's own objects


def parked_car(layout: Layout, s: float, side: float, chance: float) -> None:
    """Park a car with a chance; a place that stays free is remembered."""
    rng = layout.rng
    if rng.random() < chance:
        yaw = (0.0 if side < 0 else np.pi) + rng.normal(0.0, 0.03)
        layout.place(s, side * (CURB_OFFSET_M - 1.05 + rng.normal(0, 0.08)), yaw, 0.9, street.car, _CAR_CLEARANCE_M)
    else:
        layout.free_places.append((s, side))


def park_again(layout: Layout, chance: float, rng: np.random.Generator) -> None:
    """Let most parked cars leave and others come, in their places or in free ones; all else stays as it is."""
    standing = [replace(item, number=number) for number, item in enumerate(layout.items)]
    layout.items, layout.rng = [], rng
    free, layout.free_places = layout.free_places, []
    for s, side in free:
        parked_car(layout, s, side, (1 - _STAYING_SHARE) * chance)
    for item in standing:
        if item.build is not street.car or rng.random() < _STAYING_SHARE:
            layout.items.append(item)
        elif rng.random() < chance:
            along = rng.normal(0.0, _PARKED_AGAIN_SIGMA_M)
            x, y = item.x + along * np.cos(item.yaw), item.y + along * np.sin(item.yaw)
            layout.items.append(replace(item, x=float(x), y=float(y), number=None))
    own = [item for item in layout.items if item.number is not None]
    new = [item for item in layout.items if item.number is None]
    layout.items = own + [replace(item, number=_NEW_CARS + int(rng.integers(_NEW_CARS))) for item in new]
