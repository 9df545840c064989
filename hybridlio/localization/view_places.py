"""Recognition of places in a map of points alone, by what a lidar would see from its viewpoints.

The views that the map would give from its viewpoints are rendered for the lidar of the run, and described like
keyframes (:mod:`hybridlio.smoothing.place_recognition`). A scan is compared with all of them, over all headings, and
registered to the map from the most similar.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.localization.fusion import UncertainPose
from hybridlio.localization.map_matching import MapMatch, MapMatchingSettings, match_with_map
from hybridlio.localization.map_surface import MapSurface
from hybridlio.localization.viewpoints import Eye, Viewpoints, ground_m
from hybridlio.registration.motion_search import CoarseSearch, refine_best
from hybridlio.registration.results import Registration
from hybridlio.smoothing.place_recognition import DescriptorSettings, descriptor_spectrum, place_descriptor
from hybridlio.smoothing.places import levelling_rotations
from hybridlio.sources.thinned_scan import ThinnedScan

_log = logging.getLogger(__name__)

_SPACING_M = 2.5  # of viewpoints in streets: a ring of the descriptor is 3.5 m wide
_OUTLYING = 0.5  # percent of the points beyond either end of the field of view
# Viewpoints with headings from which a scan is registered. In an office (simulated, seed 61) of 280 viewpoints of four
# likely headings, the right one was among the first 40 for 65 % of the scans, and among 120 for 85 %; with 16 beams
# (seed 5) more are needed.
_CANDIDATES = 200
_DIFFERENT_RAD = np.deg2rad(15.0)  # headings of one viewpoint nearer than this are one candidate
# Starts about each candidate, in spacings: half-way to the viewpoints beside it.
_OFFSETS = ((0.0, 0.0), (0.5, 0.0), (-0.5, 0.0), (0.0, 0.5), (0.0, -0.5))
_SEARCH = CoarseSearch(kernel_m=2.0, iterations=8, refined=12)  # as for loops; of the starts of several candidates
_JUDGED_STRIDE, _SPARSE = 16, 4  # every 16th point compares starts, every fourth refines them
_SAME_M, _MATCHED = 0.5, 4  # refined poses nearer than this are one; the best four are matched with all points
# Of a refined start, whose poses within that distance are one: the final registration begins with a kernel as wide, and
# gives the true covariance.
_REFINED_SIGMAS = np.repeat([np.deg2rad(0.5), _SAME_M / np.sqrt(3)], 3)


@dataclass(frozen=True, eq=False)
class _Described:
    """The viewpoints as one lidar sees them, and the spectra ``(K, R, F)`` of their descriptors."""

    eye: Eye
    viewpoints: Viewpoints
    spectra: NDArray[np.complex64]

    def suits(self, eye: Eye) -> bool:
        """Return whether another scan can be compared: its height above the floor is that of the viewpoints, about."""
        return abs(eye.height_m - self.eye.height_m) < self.eye.spacing_m / 2


class ViewPlaces:
    """The places of a map of points alone.

    Args:
        surface: of the map.
        up: ``(3,)`` in the map frame.
        matching: of scans with the map; its scale is the scene's, and lengths are that share of those for streets.
    """

    def __init__(self, surface: MapSurface, up: Array, matching: MapMatchingSettings) -> None:
        self._surface, self._matching, self._scale = surface, matching, matching.scale
        self._T_level_map = levelling_rotations(np.eye(4)[None], up)[0]
        usual = DescriptorSettings()
        self._settings = DescriptorSettings(
            range_m=self._scale * usual.range_m, height_m=self._scale * usual.height_m, beside_m=(0.0,)
        )
        self._described: _Described | None = None

    def recognise(self, scan: ThinnedScan, T_level_lidar: Array) -> MapMatch | None:
        """Return where the scan fits the map best, if it fits there; None else.

        Args:
            scan: motion compensated.
            T_level_lidar: ``(4, 4)`` rotation that makes z up.
        """
        starts = self._starts(scan.points, T_level_lidar)
        if not starts or len(scan.source) < self._matching.min_points:
            return None
        surface, registration = self._surface.whole, self._matching.registration
        few, sparse = scan.source[::_JUDGED_STRIDE], scan.source[::_SPARSE]
        search = CoarseSearch(self._scale * _SEARCH.kernel_m, _SEARCH.iterations, _SEARCH.refined)
        refined = refine_best(surface, few, sparse, starts, registration, search)
        matches = [self._match(scan, pose) for pose in self._distinct(refined)]
        fitting = [match for match in matches if match is not None and match.holds]
        return min(fitting, key=lambda match: match.cost, default=None)

    def _distinct(self, refined: list[Registration]) -> list[Array]:
        """Return the best of refined poses that are not one and the same."""
        out: list[Array] = []
        for one in sorted(refined, key=lambda one: one.cost):
            if all(np.linalg.norm(one.pose[:3, 3] - pose[:3, 3]) > self._scale * _SAME_M for pose in out):
                out.append(one.pose)
        return out[:_MATCHED]

    def _match(self, scan: ThinnedScan, pose: Array) -> MapMatch | None:
        lengths = np.repeat([1.0, self._scale], 3)
        near = UncertainPose(pose, np.diag((lengths * _REFINED_SIGMAS) ** 2))
        return match_with_map(self._surface, scan, near, self._matching, is_in_question=True)

    def _starts(self, points: Array, T_level_lidar: Array) -> list[Array]:
        """Return poses ``T_map_lidar`` from which to register a scan, about those of the most similar views."""
        level = se3.transform(T_level_lidar, points)
        floor_m = ground_m(level, np.zeros(2), self._scale)
        if np.isnan(floor_m):
            return []
        described = self._describe(self._eye(level, -floor_m))
        spectrum = descriptor_spectrum(place_descriptor(level, self._settings))
        T_map_level = se3.inverse(self._T_level_map)
        steps = [described.eye.spacing_m * np.array([x, y, 0.0]) for x, y in _OFFSETS]
        return [
            T_map_level @ se3.make(se3.so3_exp((0.0, 0.0, yaw)), described.viewpoints.positions[k] + step)
            @ T_level_lidar
            for k, yaw in self._most_similar(described.spectra, spectrum)
            for step in steps
        ]  # fmt: skip

    def _most_similar(self, spectra: NDArray[np.complex64], spectrum: NDArray[np.complex64]) -> list[tuple[int, float]]:
        """Return viewpoints and headings of the most similar views."""
        sectors = self._settings.sectors
        similarity = np.fft.irfft((np.conj(spectrum) * spectra).sum(axis=-2), n=sectors, axis=-1)
        around = round(_DIFFERENT_RAD / (2 * np.pi / sectors))
        beside = [np.roll(similarity, shift, axis=1) for shift in range(-around, around + 1) if shift]
        peaks = np.flatnonzero(similarity.ravel() > np.max(beside, axis=0).ravel())
        best = peaks[np.argsort(-similarity.ravel()[peaks], kind="stable")[:_CANDIDATES]]
        return [(int(k), 2 * np.pi / sectors * float(shift)) for k, shift in zip(*divmod(best, sectors), strict=True)]

    def _eye(self, level: Array, height_m: float) -> Eye:
        elevations = np.arctan2(level[:, 2], np.hypot(level[:, 0], level[:, 1]))
        lowest, highest = np.percentile(elevations, [_OUTLYING, 100.0 - _OUTLYING])
        return Eye(height_m, float(lowest), float(highest), self._settings.range_m, self._scale * _SPACING_M)

    def _describe(self, eye: Eye) -> _Described:
        if self._described is None or not self._described.suits(eye):
            points, normals = self._surface.points, self._surface.normals @ self._T_level_map[:3, :3].T
            viewpoints = Viewpoints(se3.transform(self._T_level_map, points), normals, eye, self._scale)
            _log.info("rendering the map from %d viewpoints %.1f m above the floor", len(viewpoints), eye.height_m)
            shape = (len(viewpoints), self._settings.rings, self._settings.sectors // 2 + 1)
            spectra = np.empty(shape, np.complex64)
            for k in range(len(viewpoints)):
                spectra[k] = descriptor_spectrum(place_descriptor(viewpoints.view(k), self._settings))
            self._described = _Described(eye, viewpoints, spectra)
        return self._described
