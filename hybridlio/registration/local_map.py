"""The local map: points of recent keyframes with planes, in one voxel map, as a surface to register to.

A new surface with its k-d tree over all points is costly. So each keyframe's new points are appended to the surface,
and it is rebuilt only when many have been appended or the vehicle has moved far: preferably at a scan that brings no
keyframe, which has time to spare.
"""

from __future__ import annotations

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.registration.settings import LocalMapSettings
from hybridlio.registration.surface import Surface
from hybridlio.registration.voxel_map import VoxelMap

# The surface is due for a rebuild when its small tree holds this share of the large one's points (searching both costs
# more than a rebuild spread over the keyframes saves), or the keyframe has moved by this share of the radius (at 100 m,
# 12 m: six keyframes).
_REBUILD_APPENDED_RATIO = 0.12
_REBUILD_DISTANCE_RATIO = 0.12
_OVERDUE = 2.0  # times that: rebuilt at a keyframe, if every scan has been one
# Keyframes from which on the map is taken to have no gaps. Of 16 beams in an open field, a map of one keyframe has
# planes near 0.47 of that keyframe's own points, of two 0.73, of five 0.81; in a town of one 0.91.
_FILLED_KEYFRAMES = 5


class LocalMap:
    """Keyframes' points as one surface; starts empty, in the frame of the first keyframe.

    Attributes:
        keyframes: number of keyframes inserted.
        surface: the current surface, None while no points have planes.
    """

    def __init__(self, settings: LocalMapSettings) -> None:
        self._settings = settings
        self._voxels = VoxelMap(settings)
        self._T_map_keyframe: Array | None = None
        self._centre: Array = np.zeros(3)  # of the surface when it was last rebuilt
        self.keyframes = 0
        self.surface: Surface | None = None

    @property
    def only_keyframe_pose(self) -> Array | None:
        """``(4, 4)`` pose of the only keyframe; None where there are none or several."""
        return self._T_map_keyframe if self.keyframes == 1 else None

    def rescale(self, settings: LocalMapSettings) -> None:
        """Go on with other settings, at another scale of the scene; the points stay."""
        self._settings = settings
        self._voxels.rescale(settings)

    def needs_keyframe(self, T_map_lidar: Array) -> bool:
        """Return whether a scan at this pose should become a keyframe."""
        if self._T_map_keyframe is None:
            return True
        step = se3.between(self._T_map_keyframe, T_map_lidar)
        angle_deg = np.rad2deg(np.arccos(np.clip((np.trace(step[:3, :3]) - 1) / 2, -1.0, 1.0)))
        return bool(np.linalg.norm(step[:3, 3]) > self._settings.keyframe_m or angle_deg > self._settings.keyframe_deg)

    def insert(self, points: Array, T_map_lidar: Array) -> None:
        """Add a scan's points ``(N, 3)``, lidar frame, as a keyframe at this pose."""
        new = self._voxels.insert(points, T_map_lidar, self.surface)
        self._T_map_keyframe = T_map_lidar
        self.keyframes += 1
        if self.surface is not None:
            self.surface = self.surface.extended(new.points, new.normals, self._settings.threads, new.weights)
        if self._rebuild_ratio() > _OVERDUE:
            self._rebuild()

    def covered(self, points: Array, T_map_lidar: Array, distance_m: float) -> float:
        """Return how many of a scan's points at a pose have a plane nearby: no scan of this place can match more.

        The ground between the rings of the only scan has none. What a map of several keyframes covers has no limit.

        Args:
            points: ``(N, 3)`` lidar frame.
            T_map_lidar: ``(4, 4)``.
            distance_m: to the nearest plane.
        """
        if self.surface is None or self.keyframes >= _FILLED_KEYFRAMES:
            return np.inf
        distance2 = self.surface.nearest(se3.transform(T_map_lidar, points), self._settings.threads)[1]
        return float(np.count_nonzero(distance2 < distance_m**2))

    def rebuild_if_due(self) -> None:
        """Rebuild the surface where that is due; to be called at scans that bring no keyframe."""
        if self.keyframes and self._rebuild_ratio() > 1:
            self._rebuild()

    def _rebuild_ratio(self) -> float:
        """Return how far the surface is towards being due for a rebuild, which it is at 1."""
        if self.surface is None or self._T_map_keyframe is None:
            return np.inf
        moved_m = float(np.linalg.norm(self._T_map_keyframe[:3, 3] - self._centre))
        moved_ratio = moved_m / (_REBUILD_DISTANCE_RATIO * self._settings.radius_m)
        return max(self.surface.appended_ratio / _REBUILD_APPENDED_RATIO, moved_ratio)

    def _rebuild(self) -> None:
        """Build the surface of the retained points within the radius; without points there is none."""
        assert self._T_map_keyframe is not None
        self._centre = self._T_map_keyframe[:3, 3]
        planes = self._voxels.drop_expired()
        offsets = planes.points - self._centre
        near = np.flatnonzero(np.einsum("ij,ij->i", offsets, offsets) < self._settings.radius_m**2)
        self.surface = None
        if len(near):
            points, normals, weights = (column.take(near, axis=0) for column in planes)
            self.surface = Surface(points, normals, self._settings.threads, weights, one_sided=self._settings.one_sided)
