"""Where a lidar can have stood in a map of points alone, and what it would see from there.

A viewpoint lies as high above a floor as the lidar, over ground that the map covers densely, with free space around.
A floor is any patch of horizontal surface, so that a building has one on every storey.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from hybridlio.cloud.voxel import voxel_average, voxel_pick
from hybridlio.core.arrays import Array, Mask
from hybridlio.localization.map_surface import VOXEL_M

_LEVEL = 0.9  # cosine of 26°: a floor is no steeper, the steepest streets have 20°
_CLEAR_M = 0.3  # about the lidar and its carrier: half the width of a person or of a small robot
_CARRIER = np.array([0.4, 0.6, 0.8, 1.0])  # heights at which space must be free, as shares of the lidar's
# Ground is dense where a lidar has passed within a few metres: a disc holds half of what the densest tenth does.
_DENSE, _DENSEST_PERCENTILE, _DISC_VOXELS = 0.5, 90.0, 5.0
_RENDERED_VOXELS = 2.0  # points to render are thinned to two voxels of the map
# Bins of the panoramas, from fine to coarse. A point hides what is behind it in the finest bins that its voxel fills.
_BINS_DEG = (1.0, 2.0, 4.0, 8.0, 16.0)
_BEHIND = 0.15  # of the range by which a point must lie behind another to be hidden: surfaces seen at 30° reach as deep
GROUND_RADIUS_M = 10.0  # about the start; a lidar of 16 beams on a car sees its first ring of the ground at 7 m
_GROUND_PERCENTILE = 10.0  # of the heights there: below cars and kerbs, above stray points
_GROUND_VOXEL_M = 0.3  # so that near rings do not outnumber the others
_MARGIN_RAD = np.deg2rad(1.0)  # about the field of view


@dataclass(frozen=True)
class Eye:
    """The lidar whose view is rendered.

    Attributes:
        height_m: above the floor.
        lowest_rad, highest_rad: elevations of its field of view.
        range_m: of the view.
        spacing_m: between viewpoints.
    """

    height_m: float
    lowest_rad: float
    highest_rad: float
    range_m: float
    spacing_m: float


class Viewpoints:
    """The viewpoints of a map.

    Args:
        points: ``(N, 3)`` of the map, z up, one a voxel.
        normals: ``(N, 3)`` of the surfaces there.
        eye: the lidar.
        scale: of the scene, of which the map's voxels are that share of a street's.

    Attributes:
        positions: ``(K, 3)`` of the lidar.
    """

    def __init__(self, points: Array, normals: Array, eye: Eye, scale: float) -> None:
        self._eye, voxel_m = eye, scale * VOXEL_M
        floor = points[np.abs(normals[:, 2]) > _LEVEL]
        self._spacing_m = _RENDERED_VOXELS * voxel_m
        self._points = voxel_average(points.astype(np.float32), None, self._spacing_m)[0].astype(np.float64)
        self._flat = cKDTree(self._points[:, :2])
        self.positions: Array = _free(points, _dense(floor, eye.spacing_m, voxel_m), eye.height_m)

    def __len__(self) -> int:
        return len(self.positions)

    def view(self, k: int) -> Array:
        """Return the points ``(M, 3)`` that the lidar would see from a viewpoint, relative to it."""
        position = self.positions[k]
        near = self._flat.query_ball_point(position[:2], self._eye.range_m, return_sorted=False)
        relative = self._points[near] - position
        elevation = np.arctan2(relative[:, 2], np.hypot(relative[:, 0], relative[:, 1]))
        inside = elevation > self._eye.lowest_rad - _MARGIN_RAD
        inside &= elevation < self._eye.highest_rad + _MARGIN_RAD
        relative, elevation = relative[inside], elevation[inside]
        return np.asarray(relative[_visible(relative, elevation, self._spacing_m)])


def _dense(floor: Array, spacing_m: float, voxel_m: float) -> Array:
    """Return floor points, one in each cell of a grid, around which the floor is dense."""
    if not len(floor):
        return floor
    picked = floor[voxel_pick(floor, spacing_m)]
    radius_m = _DISC_VOXELS * voxel_m
    counts = cKDTree(floor).query_ball_point(picked, radius_m, return_length=True)
    return np.asarray(picked[counts > _DENSE * np.percentile(counts, _DENSEST_PERCENTILE)])


def _free(points: Array, floor: Array, height_m: float) -> Array:
    """Return the positions above floor points at which the lidar and its carrier have room."""
    positions, tree = floor + np.array([0.0, 0.0, height_m]), cKDTree(points)
    clear_m = min(_CLEAR_M, _CARRIER[0] * height_m)
    for share in _CARRIER:
        distance_m, _ = tree.query(
            positions - np.array([0.0, 0.0, (1 - share) * height_m]), distance_upper_bound=clear_m
        )
        positions = positions[np.isinf(distance_m)]
    return np.asarray(positions)


def _visible(points: Array, elevation: Array, spacing_m: float) -> Mask:
    """Return which points ``(N, 3)`` about the origin no nearer one hides; each covers the angle of its spacing."""
    ranges = np.linalg.norm(points, axis=1)
    azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0])) + 180.0
    elevation = np.degrees(elevation) + 90.0
    covered_deg = np.degrees(spacing_m / np.maximum(ranges, spacing_m))
    visible, finest_deg = np.ones(len(points), bool), 0.0
    for bin_deg in _BINS_DEG:
        columns = round(360.0 / bin_deg)
        cells = (elevation // bin_deg).astype(np.intp) * (columns + 1) + (azimuth // bin_deg).astype(np.intp)
        fills = (covered_deg > finest_deg) & (covered_deg <= bin_deg)
        nearest = np.full((round(180.0 / bin_deg) + 1) * (columns + 1), np.inf)
        np.minimum.at(nearest, cells[fills], ranges[fills])
        visible &= ranges <= nearest[cells] * (1 + _BEHIND) + spacing_m
        finest_deg = bin_deg
    return visible


def ground_m(points: Array, xy: Array, scale: float = 1.0) -> float:
    """Return the height of the ground about a position ``(2,)``; NaN without points. In rooms the scale is below 1."""
    near = points[np.hypot(*(points[:, :2] - xy).T) < scale * GROUND_RADIUS_M]
    if not len(near):
        return float("nan")
    return float(np.percentile(near[voxel_pick(near, scale * _GROUND_VOXEL_M), 2], _GROUND_PERCENTILE))
