"""Open ground, and objects scattered on it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.simulation.platforms.scenes.scene import clearance
from hybridlio.simulation.world.ground import Height
from hybridlio.simulation.world.items import Build
from hybridlio.simulation.world.shapes import Mesh

_TRIES = 6  # places tried for an object, on average
_GRASS = 0.4  # reflectance, plausible at 905 nm


def terrain(height: Height, low: Array, high: Array, cell_m: float) -> Mesh:
    """Return the ground between corners ``low`` and ``high`` ``(2,)`` as a regular grid of triangles."""
    count = np.ceil((high - low) / cell_m).astype(int)
    axes = [a + cell_m * np.arange(n + 1) for a, n in zip(low, count, strict=True)]
    xy = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    row = int(count[1]) + 1
    corner = (np.arange(count[0])[:, None] * row + np.arange(count[1])).reshape(-1)
    lower = np.column_stack([corner, corner + row + 1, corner + 1])
    upper = np.column_stack([corner, corner + row, corner + row + 1])
    triangles = np.concatenate([lower, upper])
    return Mesh(np.column_stack([xy, height(xy)]), triangles, np.full(len(triangles), _GRASS))


@dataclass(eq=False)
class Plot:
    """A piece of land that objects are placed on, clear of the way and of each other.

    Attributes:
        low, high: ``(2,)`` corners of the rectangle in which objects are placed.
        way: ``(N, 2+)``.
        height: of the ground.
        taken: circles that are occupied: centre ``(2,)`` and radius.
    """

    low: Array
    high: Array
    way: Array
    height: Height
    taken: list[tuple[Array, float]] = field(default_factory=list)

    def is_free(self, centre: Array, radius_m: float) -> bool:
        """Return whether a circle overlaps none that is taken."""
        return all(np.linalg.norm(centre - other) > radius_m + size for other, size in self.taken)

    def scatter(
        self, build: Build, count: int, margin_m: float, radius_m: float, rng: np.random.Generator
    ) -> list[Mesh]:
        """Return up to ``count`` objects at random places.

        Args:
            build: makes an object on the origin.
            count: of objects.
            margin_m: least distance of its middle from the way.
            radius_m: of what it occupies.
            rng: of places and shapes.
        """
        spots = rng.uniform(self.low, self.high, (count * _TRIES, 2))
        parts: list[Mesh] = []
        for spot in spots[clearance(spots, self.way) > margin_m]:
            if len(parts) < count and self.is_free(spot, radius_m):
                self.taken.append((spot, radius_m))
                yaw = float(rng.uniform(-np.pi, np.pi))
                parts.append(build(rng).placed(spot[0], spot[1], self.height(spot[None])[0], yaw))
        return parts
