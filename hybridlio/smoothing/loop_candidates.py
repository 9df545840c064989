"""Candidate loops: pairs of keyframes that odometry cannot rule out and whose descriptors are most similar."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Index
from hybridlio.core.setting_checks import check_fraction, check_not_negative, check_positive
from hybridlio.smoothing.place_index import PlaceIndex, Similar, describe
from hybridlio.smoothing.place_recognition import DescriptorSettings
from hybridlio.smoothing.places import Places
from hybridlio.smoothing.step_uncertainty import OdometryChain

# Below these standard deviations odometry itself is a guess from which the verification, which searches ±3 m, succeeds.
_SURE_M, _SURE_RAD = 2.0, 0.1


@dataclass(frozen=True)
class CandidateSettings:
    """How candidates are chosen.

    Attributes:
        min_path_m: places nearer than this along the path are no revisits.
        reach_m: places this near are possible, and farther ones by odometry's uncertainty.
        odometry_sigmas: standard deviations by which odometry may be wrong.
        odometry_scale: factor on odometry's covariances; see ``ConsistencySettings``.
        max_distance: descriptors farther apart are of different places, unless odometry is sure.
        per_keyframe: candidates of each keyframe, the most similar first.
        apart_m: least distance along the path between the candidates of a keyframe.
        compared: possible places, those of the nearest ring keys, whose descriptors are compared.
        descriptor: how places are described.

    Raises:
        SettingError: a value is out of range.
    """

    min_path_m: float = 40.0
    reach_m: float = 10.0
    odometry_sigmas: float = 3.0
    odometry_scale: float = 4.0
    max_distance: float = 0.45
    per_keyframe: int = 2
    apart_m: float = 20.0
    compared: int = 100
    descriptor: DescriptorSettings = field(default_factory=DescriptorSettings)

    def __post_init__(self) -> None:
        check_positive(self, "odometry_sigmas", "odometry_scale", "per_keyframe", "compared")
        check_not_negative(self, "min_path_m", "reach_m", "apart_m")
        check_fraction(self, "max_distance")


@dataclass(frozen=True, eq=False)
class Candidate:
    """Two keyframes that may be of one place.

    Attributes:
        earlier, later: their numbers.
        distance: between their descriptors, 0 to 1.
        guesses: ``(4, 4)`` poses ``T_earlier_later`` to start registration from.
    """

    earlier: int
    later: int
    distance: float
    guesses: tuple[Array, ...]


class CandidateFinder:
    """Finds the candidates of each keyframe among the earlier ones.

    Args:
        chain: the run's odometry.
        rows: ``(K,)`` rows of the run that are keyframes.
        places: the keyframes.
        settings: limits.
    """

    def __init__(self, chain: OdometryChain, rows: Index, places: Places, settings: CandidateSettings) -> None:
        self._chain, self._rows, self._settings, self._places = chain, rows, settings, places
        self._index = PlaceIndex(len(rows), settings.descriptor)

    def add(self, k: int) -> list[Candidate]:
        """Add keyframe ``k`` and return its candidates; keyframes are added in order."""
        description = describe(self._places, k, self._settings.descriptor)
        self._index.add(description)
        possible, sure = self._possible(k)
        if not len(possible):
            return []
        possible = self._index.nearest_keys(description.key, possible, self._settings.compared)
        similar = self._index.similar(description, possible)
        limit = np.inf if sure else self._settings.max_distance
        chosen = most_similar(similar, self._places.travelled_m, self._settings, limit)
        return [self._candidate(k, one, sure) for one in chosen]

    def _possible(self, k: int) -> tuple[Index, bool]:
        """Earlier keyframes that may be nearby, and whether odometry is sure of its relative poses to all of them."""
        settings, row = self._settings, self._rows[k]
        travelled = self._places.travelled_m
        earlier = np.flatnonzero(travelled[k] - travelled[:k] >= settings.min_path_m)
        if not len(earlier):
            return earlier, False
        i, j = self._rows[earlier], np.full(len(earlier), row)
        covariances = settings.odometry_scale * self._chain.covariance(i, j)
        sigma_m = np.sqrt(np.linalg.eigvalsh(covariances[:, 3:, 3:])[:, -1])
        sigma_rad = np.sqrt(np.linalg.eigvalsh(covariances[:, :3, :3])[:, -1])
        apart = np.linalg.norm(self._chain.relative(i, j)[:, :3, 3], axis=1)
        near = apart <= settings.reach_m + settings.odometry_sigmas * sigma_m
        sure = (sigma_m[near] < _SURE_M).all() and (sigma_rad[near] < _SURE_RAD).all()
        return earlier[near], bool(sure)

    def _candidate(self, k: int, one: Similar, sure: bool) -> Candidate:
        """The candidate with guesses from the descriptors, and from odometry where that is sure."""
        guesses = [guess(self._places, self._places, one, k)]
        if sure:
            guesses.append(self._chain.relative(self._rows[one.place], self._rows[k]))
        return Candidate(one.place, k, one.distance, tuple(guesses))


def guess(earlier: Places, later: Places, one: Similar, k: int) -> Array:
    """Return the pose ``(4, 4)`` of place ``k`` of ``later`` in the frame of a similar one of ``earlier``, about."""
    return np.asarray(se3.inverse(earlier.levels[one.place]) @ one.T_level_level @ later.levels[k])


def most_similar(
    similar: list[Similar], travelled_m: Array, settings: CandidateSettings, max_distance: float
) -> list[Similar]:
    """Return the most similar places, apart along the path, no more than the settings allow.

    Args:
        similar: places.
        travelled_m: ``(K,)`` distance along the path of each place of the index.
        settings: number and distance of candidates.
        max_distance: descriptors farther apart are of different places.
    """
    out = list[Similar]()
    for one in sorted(similar, key=lambda one: one.distance):
        if len(out) == settings.per_keyframe or one.distance > max_distance:
            break
        if all(abs(travelled_m[one.place] - travelled_m[taken.place]) > settings.apart_m for taken in out):
            out.append(one)
    return out
