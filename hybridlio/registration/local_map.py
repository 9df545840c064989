"""The local map: recent keyframes' points with normals in one voxel map, as a surface to register to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybridlio.cloud.plane_fitting import LEAST_NEIGHBOURS
from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.setting_checks import check_positive, check_setting
from hybridlio.registration.surface import Surface
from hybridlio.registration.voxel_map import MapCells

_FRESH_SHARE = 0.12
_FAR_SHARE = 0.12  # of the radius
_WORN_OUT = 2.0  # times that, where no scan came without a keyframe


@dataclass(frozen=True)
class LocalMapSettings:
    """How the map is kept.

    Attributes:
        keyframe_m, keyframe_deg: a scan this far from the last keyframe becomes one.
        voxel_m: cells of the map; each holds up to ten points at least 10 cm apart.
        horizon_keyframes: a cell that so many keyframes have not touched is forgotten, when the surface is next made
            of all points: after some keyframes.
        radius_m: points farther from the keyframe are left out of the surface then.
        neighbours: points to fit a plane to for a normal.
        threads: for normals and trees.

    Raises:
        SettingError: a value is out of range.
    """

    __pydantic_config__ = {"extra": "forbid"}  # noqa: RUF012  (read from YAML: unknown keys are errors)

    keyframe_m: float = 2.0
    keyframe_deg: float = 10.0
    voxel_m: float = 2.0
    horizon_keyframes: int = 30
    radius_m: float = 100.0
    neighbours: int = 10
    threads: int = 2

    def __post_init__(self) -> None:
        check_positive(self, "keyframe_m", "keyframe_deg", "voxel_m", "horizon_keyframes", "radius_m", "threads")
        check_setting(
            self, "neighbours", self.neighbours >= LEAST_NEIGHBOURS, f"{LEAST_NEIGHBOURS} or more, as a plane needs"
        )


class LocalMap:
    """Starts empty, in the frame of the first keyframe."""

    def __init__(self, settings: LocalMapSettings) -> None:
        self._settings = settings
        self._cells = MapCells(settings.voxel_m, settings.horizon_keyframes, settings.neighbours, settings.threads)
        self._keyframe: Array | None = None
        self._middle: Array = np.zeros(3)  # of the surface when it was last made of all points
        self.keyframes = 0
        self.surface: Surface | None = None

    @property
    def alone(self) -> Array | None:
        """``(4, 4)`` pose of the only keyframe; None where there are none or several."""
        return self._keyframe if self.keyframes == 1 else None

    def wants(self, T_map_lidar: Array) -> bool:
        """Whether a scan at this pose should become a keyframe."""
        if self._keyframe is None:
            return True
        step = se3.between(self._keyframe, T_map_lidar)
        angle_deg = np.rad2deg(np.arccos(np.clip((np.trace(step[:3, :3]) - 1) / 2, -1.0, 1.0)))
        return bool(np.linalg.norm(step[:3, 3]) > self._settings.keyframe_m or angle_deg > self._settings.keyframe_deg)

    def insert(self, points: Array, T_map_lidar: Array) -> None:
        """Take a scan's points ``(N, 3)``, lidar frame, as a keyframe at this pose into the surface."""
        new = self._cells.insert(points, T_map_lidar, self.surface)
        self._keyframe = T_map_lidar
        self.keyframes += 1
        if self.surface is not None:
            self.surface = self.surface.grown(new.points, new.normals, self._settings.threads, new.weights)
        if self._wear() > _WORN_OUT:
            self._renew()

    def tidy(self) -> None:
        """Make the surface anew where that is due: at a scan that brings no keyframe, which takes long enough."""
        if self.keyframes and self._wear() > 1:
            self._renew()

    def _wear(self) -> float:
        """How much has come since the surface was made of all points, or how far the keyframe is from there; of 1."""
        if self.surface is None or self._keyframe is None:
            return np.inf
        way_m = float(np.linalg.norm(self._keyframe[:3, 3] - self._middle))
        return max(self.surface.fresh_share / _FRESH_SHARE, way_m / (_FAR_SHARE * self._settings.radius_m))

    def _renew(self) -> None:
        """Make the surface of what is remembered within the radius; of nothing there is none."""
        assert self._keyframe is not None
        self._middle = self._keyframe[:3, 3]
        planes = self._cells.remembered()
        away = planes.points - self._middle
        near = np.flatnonzero(np.einsum("ij,ij->i", away, away) < self._settings.radius_m**2)
        self.surface = None
        if len(near):
            points, normals, weights = (column.take(near, axis=0) for column in planes)
            self.surface = Surface(points, normals, self._settings.threads, weights)
