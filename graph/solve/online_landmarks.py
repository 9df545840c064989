"""Landmarks of an online solver: which are variables, and which have left the lag."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from gtsam.symbol_shorthand import L

from hybridlio.core.arrays import Array
from hybridlio.core.errors import GraphError
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.model.keys import Key
from hybridlio.graph.model.measurements import OBSERVATIONS, OF_LANDMARKS, PARTIAL_OBSERVATIONS, Factor
from hybridlio.graph.solve.landmark_factors import landmark_point


class OnlineLandmarks:
    """Keeps count of landmarks, which become variables at their first observation.

    In a lag, a landmark is marginalised together with the last pose that observed it.

    Attributes:
        estimated: indices of the landmarks that are variables.
    """

    def __init__(self, data: GraphData) -> None:
        self._data = data
        self.estimated: set[int] = set()
        self._last_seen: dict[int, int] = {}  # index of the newest pose that observed a landmark, by landmark index
        self._departed: dict[int, Array] = {}  # landmarks that left the lag, as last estimated

    def latest(self, factors: Iterable[Factor]) -> dict[int, int]:
        """Return the index of the newest pose that observes each landmark, by landmark index, over new factors too."""
        found: dict[int, int] = {}
        for factor in factors:
            if factor.kind in OF_LANDMARKS and factor.landmark is not None:
                landmark, pose = self._data.landmarks.index[factor.landmark], self._data.index[factor.keys[0]]
                found[landmark] = max(pose, found.get(landmark, self._last_seen.get(landmark, 0)))
        return found

    def check(self, factors: Iterable[Factor], removed: bool) -> None:
        """Check that new factors observe no landmark that has left the lag, and that no landmark lost all of its own.

        A range or a bearing alone is taken where something else places the landmark.

        Raises:
            GraphError: names the landmark.
        """
        factors = list(factors)
        index = self._data.landmarks.index
        placed = {factor.landmark for factor in factors if factor.kind in OBSERVATIONS}
        for factor in factors:
            if factor.landmark is None:
                continue
            if index[factor.landmark] in self._departed:
                raise GraphError(f"{factor.label}: landmark {factor.landmark} has left the lag; use a new key for it")
            is_placed = factor.landmark in placed or index[factor.landmark] in self.estimated
            if factor.kind in PARTIAL_OBSERVATIONS and not is_placed:
                raise GraphError(
                    f"{factor.label}: an online solver first needs a point, or bearing and range together, of landmark "
                    f"{factor.landmark}; optimize() by batch takes it as it is"
                )
        if removed and not self._departed:
            self._check_observed()

    def _check_observed(self) -> None:
        index = self._data.landmarks.index
        observed = {index[f.landmark] for f in self._data.other_factors.values() if f.landmark is not None}
        for key, k in index.items():
            if k in self.estimated and k not in observed:
                raise GraphError(f"no factor observes landmark {key} any more; keep one of its observations")

    def leaving(self, latest: dict[int, int], oldest: int, solver: Any) -> dict[int, Array]:
        """Return the points, by index, of the landmarks that leave when ``oldest`` is the oldest pose in the lag."""
        last_seen = self._last_seen | latest
        gone = [k for k in self.estimated if last_seen[k] < oldest]
        return {k: landmark_point(solver, k, self._data.dimension, "calculateEstimate") for k in gone}

    def accept(self, latest: dict[int, int], leaving: dict[int, Array]) -> None:
        """Count new observations as taken over, and landmarks as marginalised."""
        self._last_seen |= latest
        self.estimated |= latest.keys()
        self.estimated -= leaving.keys()
        self._departed |= leaving

    @property
    def departed(self) -> dict[int, Array]:
        """Points of the landmarks that have left the lag, by index."""
        return self._departed

    def point(self, key: Key, solver: Any) -> Array:
        """Return a landmark ``(d,)``; one that has left the lag as last estimated.

        Raises:
            GraphError: no update has added an observation of a landmark with this key.
        """
        index = self._known(key)
        if index in self._departed:
            return self._departed[index].copy()
        return landmark_point(solver, index, self._data.dimension, "calculateEstimate")

    def variable(self, key: Key) -> int:
        """Return GTSAM's variable of a landmark.

        Raises:
            GraphError: as :meth:`point`, or the landmark has left the lag.
        """
        index = self._known(key)
        if index in self._departed:
            raise GraphError(f"landmark {key} has left the lag; only its last estimate is known")
        return int(L(index))

    def _known(self, key: Key) -> int:
        index = self._data.landmarks.index.get(key, -1)
        if index not in self.estimated and index not in self._departed:
            raise GraphError(f"no update has added an observation of a landmark with key {key}")
        return index
