"""An index of places by their descriptors: returns those most similar to another place."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Floats, Index
from hybridlio.smoothing.place_recognition import (
    DescriptorSettings,
    descriptor_distances,
    descriptor_spectrum,
    place_descriptor,
    ring_key,
)
from hybridlio.smoothing.places import Places


class Description(NamedTuple):
    """Descriptors of a place.

    Attributes:
        spectra: ``(V, R, F)`` as seen from each of the viewpoints beside the path, on the path first.
        key: ``(R,)`` ring key on the path.
    """

    spectra: NDArray[np.complex64]
    key: Floats


class Similar(NamedTuple):
    """A place that is similar to another.

    Attributes:
        place: its number.
        distance: between the descriptors, 0 to 1.
        T_level_level: ``(4, 4)`` pose of the other's level frame in its own, about.
    """

    place: int
    distance: float
    T_level_level: Array


class PlaceIndex:
    """Descriptors of places, as many as have been added.

    Args:
        capacity: number of places that will be added.
        settings: how places are described.
    """

    def __init__(self, capacity: int, settings: DescriptorSettings) -> None:
        self._settings = settings
        self._spectra = np.empty((capacity, settings.rings, settings.sectors // 2 + 1), np.complex64)
        self._keys = np.empty((capacity, settings.rings), np.float32)
        self._count = 0

    @classmethod
    def of(cls, places: Places, settings: DescriptorSettings) -> PlaceIndex:
        """Return the index of all places."""
        index = cls(len(places), settings)
        for k in range(len(places)):
            index.add(describe(places, k, settings))
        return index

    def add(self, description: Description) -> None:
        """Add a place; they are numbered in order."""
        self._spectra[self._count], self._keys[self._count] = description.spectra[0], description.key
        self._count += 1

    def nearest_keys(self, key: Floats, possible: Index, count: int) -> Index:
        """Return the ``count`` of the possible places with the nearest ring keys, in order of their numbers."""
        if len(possible) <= count:
            return possible
        difference = np.linalg.norm(self._keys[possible] - key, axis=1)
        return np.sort(possible[np.argpartition(difference, count)[:count]])

    def similar(self, description: Description, possible: Index) -> list[Similar]:
        """Compare a place with some of the index, each at the heading and viewpoint of greatest similarity."""
        distances, yaws = np.empty((2, len(description.spectra), len(possible)))
        for n, one in enumerate(description.spectra):
            distances[n], yaws[n] = descriptor_distances(one, self._spectra[possible], self._settings.sectors)
        views = distances.argmin(axis=0)
        return [
            Similar(int(place), float(distances[view, i]), self._relative(float(yaws[view, i]), int(view)))
            for i, (place, view) in enumerate(zip(possible, views, strict=True))
        ]

    def _relative(self, yaw: float, view: int) -> Array:
        beside = np.array([0.0, self._settings.beside_m[view], 0.0])
        return se3.make(se3.so3_exp((0.0, 0.0, yaw)), np.zeros(3)) @ se3.make(np.eye(3), -beside)


def describe(places: Places, k: int, settings: DescriptorSettings) -> Description:
    """Return the descriptors of place ``k``."""
    points = se3.transform(places.levels[k], places.surroundings(k))
    viewpoints = [(0.0, left, 0.0) for left in settings.beside_m]
    views = np.stack([place_descriptor(points - viewpoint, settings) for viewpoint in viewpoints])
    return Description(descriptor_spectrum(views), ring_key(views[0]))
