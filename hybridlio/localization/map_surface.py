"""The surface of a prior map: points with planes, to which scans anywhere in it are registered."""

from __future__ import annotations

import numpy as np

from hybridlio.cloud.kd_tree import build_tree
from hybridlio.cloud.plane_fitting import MIN_NEIGHBOURS, fit_planes
from hybridlio.cloud.voxel import voxel_average
from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.registration.surface import Surface

# The map is thinned to this distance, that of the map points of scan matching (0.6 m) within its cells of ten points.
_VOXEL_M = 0.3
_NEIGHBOURS = 10  # of a plane, as in scan matching: on a surface thinned to 0.3 m, a disc of half a metre's radius
_RADIUS_M = 100.0  # of the surface about a position: the range of scan matching
_RENEW_M = 15.0  # the surface is made anew this far from its centre; points then missing are those beyond 85 m


class MapSurface:
    """The points of a map, with planes through them.

    Args:
        points: ``(N, 3)`` metres, map frame.
        threads: for planes and trees.

    Attributes:
        points: ``(M, 3)`` thinned.

    Raises:
        DataError: there are too few points for planes.
    """

    def __init__(self, points: Array, threads: int = 2) -> None:
        origin = np.median(points, axis=0) if len(points) else np.zeros(3)
        # single precision would move points of a georeferenced map by centimetres
        local = (np.asarray(points, np.float64) - origin).astype(np.float32)
        thinned = voxel_average(local, None, _VOXEL_M)[0].astype(np.float64)
        if len(thinned) < _NEIGHBOURS:
            raise DataError(f"a map of {len(points)} points makes no surface; at least {MIN_NEIGHBOURS} points apart")
        neighbours, _ = build_tree(thinned, threads).batch_knn_search(thinned, _NEIGHBOURS, threads)
        planes = fit_planes(thinned[neighbours])
        self.points: Array = thinned + origin
        self._normals, self._weights, self._threads = planes.normals, planes.weights, threads
        self._centre: Array | None = None
        self._surface: Surface | None = None

    def around(self, position: Array) -> Surface | None:
        """Return the surface about a position ``(3,)``, map frame; None where the map has no points."""
        if self._centre is None or np.linalg.norm(position - self._centre) > _RENEW_M:
            self._centre = np.array(position)
            offsets = self.points - position
            near = np.flatnonzero(np.einsum("ij,ij->i", offsets, offsets) < _RADIUS_M**2)
            enough = len(near) >= MIN_NEIGHBOURS
            columns = self.points[near], self._normals[near], self._threads, self._weights[near]
            self._surface = Surface(*columns) if enough else None
        return self._surface
