"""The surface of a prior map: points with planes, to which scans anywhere in it are registered."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from hybridlio.cloud.kd_tree import build_tree
from hybridlio.cloud.plane_fitting import MIN_NEIGHBOURS, fit_planes
from hybridlio.cloud.voxel import voxel_average
from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.registration.surface import Surface

# The map is thinned to this distance, that of the map points of scan matching (0.6 m) within its cells of ten points.
VOXEL_M = 0.3
_NEIGHBOURS = 10  # of a plane, as in scan matching: on a surface thinned to 0.3 m, a disc of half a metre's radius
_RADIUS_M = 100.0  # of the surface about a position: the range of scan matching
_RENEW_M = 15.0  # the surface is made anew this far from its centre; points then missing are those beyond 85 m

# Normals of floors lie this near to up, as it is known better and better: a sensor is held at 30° at most, and the
# normals of a floor scatter by 3°.
_LEVEL_DEG = (30.0, 15.0, 10.0, 5.0, 5.0)


class MapSurface:
    """The points of a map, with planes through them.

    Args:
        points: ``(N, 3)`` metres, map frame.
        threads: for planes and trees.
        scale: of the scene; in rooms below 1, and points are thinned less.

    Attributes:
        points: ``(M, 3)`` thinned.
        normals: ``(M, 3)`` of the planes.

    Raises:
        DataError: there are too few points for planes.
    """

    def __init__(self, points: Array, threads: int = 2, scale: float = 1.0) -> None:
        origin = np.median(points, axis=0) if len(points) else np.zeros(3)
        # single precision would move points of a georeferenced map by centimetres
        local = (np.asarray(points, np.float64) - origin).astype(np.float32)
        thinned = voxel_average(local, None, scale * VOXEL_M)[0].astype(np.float64)
        if len(thinned) < _NEIGHBOURS:
            raise DataError(f"a map of {len(points)} points makes no surface; at least {MIN_NEIGHBOURS} points apart")
        neighbours, _ = build_tree(thinned, threads).batch_knn_search(thinned, _NEIGHBOURS, threads)
        planes = fit_planes(thinned[neighbours])
        self.points: Array = thinned + origin
        self.normals: Array = planes.normals
        self._weights, self._threads = planes.weights, threads
        self._centre: Array | None = None
        self._surface: Surface | None = None

    def level(self) -> Array:
        """Return up ``(3,)`` by the floors: the mean of the normals that are up, about.

        The z axis of a map is that of its first scan, which a hand may have held at an angle.
        """
        up = np.array([0.0, 0.0, 1.0])
        for degrees in _LEVEL_DEG:
            along = self.normals @ up
            near = np.abs(along) > np.cos(np.deg2rad(degrees))
            if not near.any():
                break
            up = (np.sign(along[near])[:, None] * self.normals[near]).sum(axis=0)
            up /= np.linalg.norm(up)
        return up

    @cached_property
    def whole(self) -> Surface:
        """The surface everywhere, for registrations at many places."""
        return Surface(self.points, self.normals, self._threads, self._weights)

    def around(self, position: Array) -> Surface | None:
        """Return the surface about a position ``(3,)``, map frame; None where the map has no points."""
        if self._centre is None or np.linalg.norm(position - self._centre) > _RENEW_M:
            self._centre = np.array(position)
            offsets = self.points - position
            near = np.flatnonzero(np.einsum("ij,ij->i", offsets, offsets) < _RADIUS_M**2)
            enough = len(near) >= MIN_NEIGHBOURS
            columns = self.points[near], self.normals[near], self._threads, self._weights[near]
            self._surface = Surface(*columns) if enough else None
        return self._surface
