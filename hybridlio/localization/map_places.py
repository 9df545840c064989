"""The places of a map, by which a run finds out where in it it is."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.smoothing.loop_candidates import CandidateSettings, guess, most_similar
from hybridlio.smoothing.loop_verification import PreparedPlaces, Verdict, VerificationSettings, Verifier
from hybridlio.smoothing.place_index import PlaceIndex, describe
from hybridlio.smoothing.places import Places


@dataclass(frozen=True, eq=False)
class Recognised:
    """A place of a map that another place was recognised as.

    Attributes:
        place: its number in the map.
        verdict: pose of the other place in its frame, with covariance.
        distance: between the descriptors.
    """

    place: int
    verdict: Verdict
    distance: float


class MapPlaces:
    """Places with known poses, as an index for recognition.

    Args:
        places: such as the keyframes of the run that made the map.
        poses: ``(K, 4, 4)`` ``T_map_place``.
        candidates, verification: as for loop closure.

    Attributes:
        places, poses: as given.
    """

    def __init__(
        self,
        places: Places,
        poses: Array,
        candidates: CandidateSettings | None = None,
        verification: VerificationSettings | None = None,
    ) -> None:
        self.places, self.poses = places, poses
        self._candidates, self._verification = candidates or CandidateSettings(), verification or VerificationSettings()
        self._prepared = PreparedPlaces(places, self._verification)

    @cached_property
    def _index(self) -> PlaceIndex:
        return PlaceIndex.of(self.places, self._candidates.descriptor)

    def recognise(self, others: Places, k: int) -> list[Recognised]:
        """Return the places of the map that place ``k`` of others is verified to be; mostly one or none.

        Args:
            others: places, such as those of a run under way.
            k: number of one of them.
        """
        if not len(self.places):
            return []
        settings = self._candidates
        description = describe(others, k, settings.descriptor)
        possible = self._index.nearest_keys(description.key, np.arange(len(self.places)), settings.compared)
        similar = self._index.similar(description, possible)
        chosen = most_similar(similar, self.places.travelled_m, settings, settings.max_distance)
        prepared = PreparedPlaces(others, self._verification)
        verifier = Verifier(self._prepared, prepared, self._verification)
        out = []
        for one in chosen:
            verdict = verifier.verify(one.place, k, [guess(self.places, others, one, k)])
            if not verdict.reason:
                out.append(Recognised(one.place, verdict, one.distance))
        return out
