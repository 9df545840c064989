"""Landmarks of a pose graph: points by key with their initial values."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.graph.model.growing_array import GrowingArray
from hybridlio.graph.model.keys import Key


class Landmarks:
    """Points in the order in which they were added; a landmark's index is its position in that order.

    Args:
        dimension: 2 or 3.
    """

    def __init__(self, dimension: int) -> None:
        self._index: dict[Key, int] = {}
        self._initial = GrowingArray((dimension,))  # NaN where there is no initial value

    def __len__(self) -> int:
        return len(self._index)

    def __contains__(self, key: object) -> bool:
        return key in self._index

    @property
    def keys(self) -> list[Key]:
        """Keys of all landmarks, in the order they were added."""
        return list(self._index)

    @property
    def index(self) -> Mapping[Key, int]:
        """Index of each landmark by key."""
        return self._index

    @property
    def initial_values(self) -> Array:
        """Initial values ``(L, d)`` of all landmarks, NaN where there is none; a copy."""
        return self._initial.array.copy()

    def initial_value(self, key: Key) -> Array | None:
        """Return the initial value ``(d,)`` of a landmark, or None."""
        point = self._initial.array[self._index[key]]
        return None if np.isnan(point[0]) else point.copy()

    def add(self, key: Key, point: Array | None = None) -> None:
        """Add a new landmark."""
        self._index[key] = len(self._index)
        self._initial.extend(np.full((1, self._initial.array.shape[1]), np.nan if point is None else point))

    def set_initial(self, key: Key, point: Array | None) -> None:
        """Replace the initial value of a landmark, or remove it (None)."""
        self._initial.array[self._index[key]] = np.nan if point is None else point

    def copy(self) -> Landmarks:
        """Return an independent copy."""
        copy = Landmarks(self._initial.array.shape[1])
        copy._index, copy._initial = self._index.copy(), self._initial.where(slice(None))
        return copy
