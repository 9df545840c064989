"""A prior map: its surface, its places, and which way is up in it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.localization.map_places import MapPlaces
from hybridlio.localization.map_surface import MapSurface

# More points than this are no rooms: at distances of 0.1 m they cover 50,000 m². They are not kept, to save memory.
_KEPT_POINTS = 5_000_000


@dataclass(frozen=True, eq=False)
class PriorMap:
    """A map that was made before.

    Attributes:
        surface: to which scans are registered.
        places: of the run that made the map; None where points alone are known, or in rooms. Places are then recognised
            by views of the surface (:class:`hybridlio.localization.view_places.ViewPlaces`).
        up: ``(3,)`` in the map frame.
        points: ``(N, 3)`` of which the surface was made, for a finer one; empty if they are not kept.
    """

    surface: MapSurface
    places: MapPlaces | None = None
    up: Array = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    points: Array = field(default_factory=lambda: np.empty((0, 3)))

    @classmethod
    def of(cls, points: Array, places: MapPlaces | None = None, up: Array | None = None) -> PriorMap:
        """Return the map of points ``(N, 3)``; without ``up`` its floors tell.

        Raises:
            DataError: there are too few points for planes.
        """
        surface = MapSurface(points)
        kept = points if len(points) <= _KEPT_POINTS else points[:0]
        return cls(surface, places, surface.level() if up is None else up, kept)

    def at_scale(self, scale: float) -> PriorMap:
        """Return the map for scenes of a scale; below 1, in rooms, its surface is finer and its places are views."""
        if scale == 1.0:
            return self
        surface = MapSurface(self.points, scale=scale) if len(self.points) else self.surface
        return replace(self, surface=surface, places=None)
