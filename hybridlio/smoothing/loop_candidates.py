"""Which pairs of keyframes may be of one place: those that odometry cannot rule out and that look most alike."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Index
from hybridlio.core.setting_checks import check_fraction, check_not_negative, check_positive
from hybridlio.smoothing.place_recognition import DescriptorSettings, compare, describe, ring_key, spectrum
from hybridlio.smoothing.step_uncertainty import OdometryChain


@dataclass(frozen=True)
class CandidateSettings:
    """How candidates are chosen.

    Attributes:
        min_path_m: places nearer along the path are no revisits.
        reach_m: a place this near is worth a look, and as much farther as odometry is unsure.
        odometry_sigmas: how many standard deviations odometry may be off by.
        odometry_scale: how much larger its covariances are taken to be than they claim.
        max_distance: pictures farther apart are of different places, unless odometry knows better.
        per_keyframe: so many of the most alike are looked at closely.
        apart_m: along the path, from one of these to the next.
        compared: so many of the possible places, those of the nearest ring keys, are compared at every turn.

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
        distance: between their pictures, 0 to 1.
        guesses: ``(4, 4)`` poses ``T_earlier_later`` to look near.
    """

    earlier: int
    later: int
    distance: float
    guesses: tuple[Array, ...]


_SURE_M, _SURE_RAD = 2.0, 0.1  # odometry is then a guess of its own


def levelled(poses: Array, up: Array) -> Array:
    """Turns ``(K, 4, 4)`` that make ``up`` ``(3,)``, of the world of the poses ``(K, 4, 4)``, the z axis of each."""
    local = poses[:, :3, :3].transpose(0, 2, 1) @ (up / np.linalg.norm(up))
    axis = np.cross(local, [0.0, 0.0, 1.0])
    sine, cosine = np.linalg.norm(axis, axis=1), local[:, 2]
    angle = np.arctan2(sine, cosine)
    rotations = se3.so3_exp(axis * (angle / np.maximum(sine, 1e-12))[:, None])
    return se3.make(rotations, np.zeros((len(poses), 3)))


class CandidateFinder:
    """Finds each keyframe's candidates among the earlier ones.

    Args:
        chain: the run's odometry.
        rows: ``(K,)`` which of its scans the keyframes are.
        up: ``(3,)`` in the first scan's frame.
        surroundings: gives the points ``(N, 3)`` around a keyframe, in its frame.
        settings: limits.
    """

    def __init__(
        self,
        chain: OdometryChain,
        rows: Index,
        up: Array,
        surroundings: Callable[[int], Array],
        settings: CandidateSettings,
    ) -> None:
        self._chain, self._rows, self._settings, self._surroundings = chain, rows, settings, surroundings
        self._levels = levelled(chain.poses[rows], up)
        descriptor = settings.descriptor
        self._spectra = np.empty((len(rows), descriptor.rings, descriptor.sectors // 2 + 1), np.complex64)
        self._keys = np.empty((len(rows), descriptor.rings), np.float32)

    def add(self, k: int) -> list[Candidate]:
        """The candidates of keyframe ``k``; keyframes are added in order."""
        descriptor = self._settings.descriptor
        points = se3.transform(self._levels[k], self._surroundings(k))
        beside = [(0.0, left, 0.0) for left in descriptor.beside_m]
        pictures = np.stack([describe(points - offset, descriptor) for offset in beside])
        spectra = spectrum(pictures)
        self._spectra[k], self._keys[k] = spectra[0], ring_key(pictures[0])
        possible, sure = self._possible(k)
        if not len(possible):
            return []
        possible = self._nearest_keys(k, possible)
        distances, yaws = np.empty((2, len(spectra), len(possible)))
        for n, one in enumerate(spectra):
            distances[n], yaws[n] = compare(one, self._spectra[possible], descriptor.sectors)
        return self._most_alike(k, possible, sure, distances, yaws)

    def _possible(self, k: int) -> tuple[Index, bool]:
        """Earlier keyframes that may be near, and whether odometry itself knows where."""
        settings, row = self._settings, self._rows[k]
        travelled = self._chain.travelled_m
        earlier = np.flatnonzero(travelled[row] - travelled[self._rows[:k]] >= settings.min_path_m)
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

    def _nearest_keys(self, k: int, possible: Index) -> Index:
        if len(possible) <= self._settings.compared:
            return possible
        difference = np.linalg.norm(self._keys[possible] - self._keys[k], axis=1)
        return np.sort(possible[np.argpartition(difference, self._settings.compared)[: self._settings.compared]])

    def _most_alike(self, k: int, possible: Index, sure: bool, distances: Array, yaws: Array) -> list[Candidate]:
        settings, out = self._settings, list[Candidate]()
        travelled = self._chain.travelled_m[self._rows[possible]]
        left = np.ones(len(possible), bool)
        best = distances.min(axis=0)
        while left.any() and len(out) < settings.per_keyframe:
            at = int(np.where(left, best, np.inf).argmin())
            left &= np.abs(travelled - travelled[at]) > settings.apart_m
            if best[at] > settings.max_distance and not sure:
                break
            view = int(distances[:, at].argmin())
            out.append(self._candidate(k, int(possible[at]), sure, float(best[at]), float(yaws[view, at]), view))
        return out

    def _candidate(self, k: int, earlier: int, sure: bool, distance: float, yaw: float, view: int) -> Candidate:
        beside = np.array([0.0, self._settings.descriptor.beside_m[view], 0.0])
        level = se3.make(se3.so3_exp((0.0, 0.0, yaw)), np.zeros(3)) @ se3.make(np.eye(3), -beside)
        guesses = [se3.inverse(self._levels[earlier]) @ level @ self._levels[k]]
        if sure:
            guesses.append(self._chain.relative(self._rows[earlier], self._rows[k]))
        return Candidate(earlier, k, distance, tuple(guesses))
