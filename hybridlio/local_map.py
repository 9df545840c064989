"""The local map: recent keyframes' points with normals in one voxel map, as a surface to register to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybridlio import se3
from hybridlio.estimates import Array
from hybridlio.map_cells import MapCells
from hybridlio.surface import Surface


@dataclass(frozen=True)
class LocalMapSettings:
    """How the map is kept.

    Attributes:
        keyframe_m, keyframe_deg: a scan this far from the last keyframe becomes one.
        voxel_m: cells of the map; each holds up to ten points at least 10 cm apart.
        horizon_keyframes: a cell that so many keyframes have not touched is forgotten.
        radius_m: points farther from the keyframe are left out of the surface.
        neighbours: points to fit a plane to for a normal.
        threads: for normals and trees.
    """

    __pydantic_config__ = {"extra": "forbid"}  # noqa: RUF012  (read from YAML: unknown keys are errors)

    keyframe_m: float = 2.0
    keyframe_deg: float = 10.0
    voxel_m: float = 2.0
    horizon_keyframes: int = 30
    radius_m: float = 100.0
    neighbours: int = 10
    threads: int = 2


class LocalMap:
    """Starts empty, in the frame of the first keyframe."""

    def __init__(self, settings: LocalMapSettings) -> None:
        self._settings = settings
        self._cells = MapCells(settings.voxel_m, settings.horizon_keyframes, settings.neighbours, settings.threads)
        self._keyframe: Array | None = None
        self.keyframes = 0
        self.surface: Surface | None = None

    def wants(self, T_map_lidar: Array) -> bool:
        """Whether a scan at this pose should become a keyframe."""
        if self._keyframe is None:
            return True
        step = se3.between(self._keyframe, T_map_lidar)
        angle_deg = np.rad2deg(np.arccos(np.clip((np.trace(step[:3, :3]) - 1) / 2, -1.0, 1.0)))
        return bool(np.linalg.norm(step[:3, 3]) > self._settings.keyframe_m or angle_deg > self._settings.keyframe_deg)

    def insert(self, points: Array, T_map_lidar: Array) -> None:
        """Take a scan's points ``(N, 3)``, lidar frame, as a keyframe at this pose and renew the surface."""
        self._cells.insert(points, T_map_lidar, self.surface)
        self._keyframe = T_map_lidar
        self.keyframes += 1
        away = self._cells.points - T_map_lidar[:3, 3]
        near = np.einsum("ij,ij->i", away, away) < self._settings.radius_m**2
        self.surface = Surface(self._cells.points[near], self._cells.normals[near], self._settings.threads)
