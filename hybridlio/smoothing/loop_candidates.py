"""Candidate loops: pairs of keyframes that odometry cannot rule out and whose descriptors are most similar."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Index
from hybridlio.core.setting_checks import check_fraction, check_not_negative, check_positive
from hybridlio.smoothing.place_recognition import (
    DescriptorSettings,
    descriptor_distances,
    descriptor_spectrum,
    place_descriptor,
    ring_key,
)
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


def levelling_rotations(poses: Array, up: Array) -> Array:
    """Return ``(K, 4, 4)`` rotations ``T_level_lidar`` that make ``up`` the z axis, by the smallest angle.

    Args:
        poses: ``(K, 4, 4)`` ``T_world_lidar``.
        up: ``(3,)`` in world.
    """
    local = poses[:, :3, :3].transpose(0, 2, 1) @ (up / np.linalg.norm(up))
    axis = np.cross(local, [0.0, 0.0, 1.0])
    sine, cosine = np.linalg.norm(axis, axis=1), local[:, 2]
    angle = np.arctan2(sine, cosine)
    rotations = se3.so3_exp(axis * (angle / np.maximum(sine, 1e-12))[:, None])
    return se3.make(rotations, np.zeros((len(poses), 3)))


class CandidateFinder:
    """Finds the candidates of each keyframe among the earlier ones.

    Args:
        chain: the run's odometry.
        rows: ``(K,)`` rows of the run that are keyframes.
        up: ``(3,)`` in the first scan's frame.
        surroundings: returns the points ``(N, 3)`` around a keyframe, in its frame.
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
        self._levels = levelling_rotations(chain.poses[rows], up)
        descriptor = settings.descriptor
        self._spectra = np.empty((len(rows), descriptor.rings, descriptor.sectors // 2 + 1), np.complex64)
        self._keys = np.empty((len(rows), descriptor.rings), np.float32)

    def add(self, k: int) -> list[Candidate]:
        """Add keyframe ``k`` and return its candidates; keyframes are added in order."""
        descriptor = self._settings.descriptor
        points = se3.transform(self._levels[k], self._surroundings(k))
        viewpoints = [(0.0, left, 0.0) for left in descriptor.beside_m]
        views = np.stack([place_descriptor(points - viewpoint, descriptor) for viewpoint in viewpoints])
        spectra = descriptor_spectrum(views)
        self._spectra[k], self._keys[k] = spectra[0], ring_key(views[0])
        possible, sure = self._possible(k)
        if not len(possible):
            return []
        possible = self._nearest_keys(k, possible)
        distances, yaws = np.empty((2, len(spectra), len(possible)))
        for n, one in enumerate(spectra):
            distances[n], yaws[n] = descriptor_distances(one, self._spectra[possible], descriptor.sectors)
        return self._most_similar(k, possible, sure, distances, yaws)

    def _possible(self, k: int) -> tuple[Index, bool]:
        """Earlier keyframes that may be nearby, and whether odometry is sure of its relative poses to all of them."""
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
        """Return the possible keyframes with the nearest ring keys, in order of their indices."""
        if len(possible) <= self._settings.compared:
            return possible
        difference = np.linalg.norm(self._keys[possible] - self._keys[k], axis=1)
        return np.sort(possible[np.argpartition(difference, self._settings.compared)[: self._settings.compared]])

    def _most_similar(self, k: int, possible: Index, sure: bool, distances: Array, yaws: Array) -> list[Candidate]:
        """Candidates by increasing distance of descriptors; ``distances`` and ``yaws`` are ``(views, possible)``."""
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
        """The candidate with guesses from yaw and view, and from odometry where that is sure."""
        beside = np.array([0.0, self._settings.descriptor.beside_m[view], 0.0])
        level = se3.make(se3.so3_exp((0.0, 0.0, yaw)), np.zeros(3)) @ se3.make(np.eye(3), -beside)
        guesses = [se3.inverse(self._levels[earlier]) @ level @ self._levels[k]]
        if sure:
            guesses.append(self._chain.relative(self._rows[earlier], self._rows[k]))
        return Candidate(earlier, k, distance, tuple(guesses))
