"""A scan as scan matching uses it: points for the map, and fewer of them to register."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hybridlio.cloud.voxel import voxel_average, voxel_count, voxel_pick
from hybridlio.core.arrays import Array, Floats, Mask
from hybridlio.core.sensors import Scan
from hybridlio.registration.local_map import LocalMap
from hybridlio.registration.settings import LocalMapSettings
from hybridlio.registration.surface import Surface
from hybridlio.sources.scene_scale import SceneScale
from hybridlio.sources.settings import ScanMatchingSettings
from hybridlio.sources.visibility import Visibility

_VOXEL_SHRINKAGE = 0.7  # halves a voxel's area, so about doubles its points, at each try to use more of a sparse scan
# A scan of this many times `least_measured` points is never too sparse: a quarter of them at least is registered with
# the default voxels, and counting the points in range is saved.
_AMPLE = 4
NEAREST_M = 0.3  # no lidar of today measures well below it, and what carries the sensor is often nearer


@dataclass(eq=False)
class ThinnedScan:
    """A scan's points in range, thinned.

    Attributes:
        points: ``(N, 3)`` metres, lidar frame, one a voxel, for the map.
        source: ``(M, 3)`` some of ``points``, to register.
        view_m: median range of the averaged points beyond :data:`NEAREST_M`, in range or not; NaN without points.
        measured: number of the scan's points, in range or not.
        settings: settings of the surface that the scan makes by itself.
    """

    points: Array
    source: Array
    view_m: float
    measured: int
    settings: LocalMapSettings

    def emptied(self) -> ThinnedScan:
        """Return the scan without its points."""
        return ThinnedScan(self.points[:0], self.source[:0], self.view_m, self.measured, self.settings)

    @cached_property
    def surface(self) -> Surface | None:
        """The scan alone as a surface to register others to, in its own frame; None where it makes no planes."""
        alone = LocalMap(self.settings)
        alone.insert(self.points, np.eye(4))
        return alone.surface


class SceneThinning:
    """Thins scans at the scale of the scene, which follows them; each scan is to be shown once.

    Args:
        given: the settings at scale 1.
    """

    def __init__(self, given: ScanMatchingSettings) -> None:
        self._scale, self._visibility = SceneScale(given), Visibility()

    @property
    def settings(self) -> ScanMatchingSettings:
        """The settings at the scene's scale."""
        return self._scale.settings

    def thin_first(self, scan: Scan) -> ThinnedScan:
        """Return the first scan at the scale that is its own; that of later ones follows scan by scan."""
        thinned = self.thin(scan)
        while self._rescale(scan, thinned):
            thinned = thin(scan, self.settings)
        return thinned

    def thin(self, scan: Scan, has_imu: bool = False) -> ThinnedScan:
        """Return the next scan at the scene's scale, which it may change.

        Args:
            scan: compensated.
            has_imu: whether an IMU can do without this scan; it then has no points if the air hides the scene.
        """
        thinned = thin(scan, self.settings)
        if self._visibility.is_lost(scan, thinned.view_m) and has_imu:
            return thinned.emptied()
        return thin(scan, self.settings) if self._rescale(scan, thinned) else thinned

    def _rescale(self, scan: Scan, thinned: ThinnedScan) -> bool:
        """Let the scale follow the scan; return whether it has changed."""
        enough = len(scan) >= self.settings.min_points
        return enough and self._scale.observe(thinned.view_m, len(thinned.points), len(scan))


def thin(scan: Scan, settings: ScanMatchingSettings) -> ThinnedScan:
    """Average the scan's points over voxels of ``map_voxel_m``, drop those out of range, and pick some to register."""
    points = voxel_average(scan.points, None, settings.map_voxel_m)[0].astype(np.float64)
    range2 = np.einsum("ij,ij->i", points, points)
    seen = range2[range2 > NEAREST_M**2]
    view_m = float(np.sqrt(np.median(seen))) if len(seen) else np.nan
    points = np.asarray(points[_in_range(range2, settings)])
    return ThinnedScan(points, _pick_source(points, scan, settings), view_m, len(scan), settings.local_map)


def _pick_source(points: Array, scan: Scan, settings: ScanMatchingSettings) -> Array:
    """Pick points to register, one a voxel of ``source_voxel_m``; of a sparse sensor, one a smaller voxel.

    Averages over few measured points are noisier, so more of them are needed for the same precision.
    """
    side_m, finest_m = settings.source_voxel_m, settings.map_voxel_m / 2
    if len(scan) < _AMPLE * settings.least_measured:
        measured_per_point = np.count_nonzero(
            _in_range(np.einsum("ij,ij->i", scan.points, scan.points), settings)
        ) / max(len(points), 1)
        single = points.astype(np.float32)  # what voxels are found of
        while side_m > finest_m and measured_per_point * voxel_count(single, side_m) < settings.least_measured:
            side_m *= _VOXEL_SHRINKAGE
    return points.take(voxel_pick(points, side_m), axis=0)


def _in_range(range2: Array | Floats, settings: ScanMatchingSettings) -> Mask:
    return np.asarray((range2 > settings.min_range_m**2) & (range2 < settings.max_range_m**2))
