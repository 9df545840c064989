"""A prior map: its surface, its places, and which way is up in it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.localization.map_places import MapPlaces
from hybridlio.localization.map_surface import MapSurface


@dataclass(frozen=True, eq=False)
class PriorMap:
    """A map that was made before.

    Attributes:
        surface: to which scans are registered.
        places: by which a run finds itself; None if they are not known.
        up: ``(3,)`` in the map frame.
    """

    surface: MapSurface
    places: MapPlaces | None = None
    up: Array = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))

    def require_places(self) -> MapPlaces:
        """Return the map's places.

        Raises:
            DataError: they are not known.
        """
        if self.places is None:
            raise DataError(
                "this map has points only, in which no place can be recognised: give a start (x, y, yaw), or the run "
                "folder that the map was made from"
            )
        return self.places
