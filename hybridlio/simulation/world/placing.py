"""Objects placed along a road, clear of the road and of one another."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial

import numpy as np
from scipy.spatial import cKDTree

from hybridlio.core.arrays import Array
from hybridlio.simulation.world import street
from hybridlio.simulation.world.ground import SIDEWALK_END_M
from hybridlio.simulation.world.items import Build, Item
from hybridlio.simulation.world.roads import Road

_HOUSE_TOLERANCE = 0.95  # neighbouring houses may touch: circles of their size may overlap by 5 %
_HOUSE_MARGIN, _OBJECT_OVERLAP = 1.15, 0.6  # an object keeps off a house's circle, but its own outline may reach in
_NEAREST_HOUSES = 60  # the last ones placed; only these can be near


@dataclass(eq=False)
class Layout:
    """Objects placed so far, each clear of the road and of the houses before it."""

    road: Road
    centre: cKDTree
    rng: np.random.Generator
    items: list[Item] = field(default_factory=list)
    free_places: list[tuple[float, float]] = field(default_factory=list)  # arc length and side
    _houses: list[tuple[float, float, float]] = field(default_factory=list)

    def place(self, s: float, left_m: float, yaw: float, radius: float, build: Build, clear_m: float) -> bool:
        """Place an object beside the road, unless it is too near to a centreline or in a house.

        Args:
            s, left_m: arc length, and metres to the left of the centreline.
            yaw: rotation from the road's heading, in radians.
            radius: of the object's outline, in metres.
            build: makes the mesh.
            clear_m: distance that the outline must keep from every centreline.

        Returns:
            Whether it was placed.
        """
        at, heading = self._at(s, left_m)
        if self.centre.query(at)[0] < clear_m + radius - 1e-6 or self._in_a_house(at, radius):
            return False
        self.items.append(Item(float(at[0]), float(at[1]), heading + yaw, radius, build))
        return True

    def place_house(self, s: float, left_m: float, width: float, depth: float, height: float, detached: bool) -> bool:
        """Place a house with its front ``left_m`` from the centreline, facing the road, unless it is in the way."""
        side = 1.0 if left_m > 0 else -1.0
        front, heading = self._at(s, left_m)
        yaw = heading if side > 0 else heading + np.pi
        c, sn = np.cos(yaw), np.sin(yaw)
        u, v = np.meshgrid(np.linspace(-width / 2, width / 2, 6), np.linspace(0.0, depth, 5))
        outline = front + np.column_stack([c * u.ravel() - sn * v.ravel(), sn * u.ravel() + c * v.ravel()])
        if self.centre.query(outline)[0].min() < min(abs(left_m), SIDEWALK_END_M) - 0.05:
            return False
        middle, radius = outline.mean(axis=0), float(min(width, depth) / 2)
        if any(
            (middle[0] - x) ** 2 + (middle[1] - y) ** 2 < (_HOUSE_TOLERANCE * (r + radius)) ** 2
            for x, y, r in self._houses
        ):
            return False
        self._houses.append((float(middle[0]), float(middle[1]), radius))
        build = partial(street.house, width, depth, height, detached)
        self.items.append(Item(float(front[0]), float(front[1]), float(yaw), 0.0, build))
        return True

    def _at(self, s: float, left_m: float) -> tuple[Array, float]:
        where = np.array([s])
        return self.road.beside(where, left_m)[0], float(self.road.heading(where)[0])

    def _in_a_house(self, at: Array, radius: float) -> bool:
        near = np.array(self._houses[-_NEAREST_HOUSES:]).reshape(-1, 3)
        distance = np.hypot(near[:, 0] - at[0], near[:, 1] - at[1])
        return bool((distance < near[:, 2] * _HOUSE_MARGIN + radius * _OBJECT_OVERLAP).any())
