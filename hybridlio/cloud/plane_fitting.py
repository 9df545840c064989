"""Planes fitted to groups of neighbouring points by principal component analysis, with a weight for each.

The normal is the eigenvector of the smallest eigenvalue of the neighbours' scatter matrix. The eigenvalues are mean
squares: the smallest is the plane's thickness squared, the middle one its width squared.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridlio.core.arrays import Array

MIN_NEIGHBOURS = 5  # of a plane: two more than its unknowns. small_gicp, too, fits none to fewer
# Thickness at which a plane has half its weight. Narrower is better on simulated drives (best at 3 cm) and worse on
# real ones, where paths become too long: real surfaces are rough and real poses of the map are not exact.
_HALF_WEIGHT_THICKNESS_M = 0.15
_SAME_RING_RAD = np.deg2rad(0.1)  # a third of the least distance between beams of spinning lidars
_MIN_OTHER_RINGS = 2  # of ten neighbours; a single one may be a stray return


class Planes(NamedTuple):
    """Points with planes through them, map frame.

    Attributes:
        points, normals: ``(M, 3)`` each.
        weights: ``(M,)`` of the planes.
    """

    points: Array
    normals: Array
    weights: Array


class FittedPlanes(NamedTuple):
    """Planes fitted to groups of neighbours.

    Attributes:
        normals: ``(M, 3)`` unit vectors, sign arbitrary.
        weights: ``(M,)``, between 0 and 1, smaller for thicker planes.
        width_m: ``(M,)`` root mean square extent of the neighbours along the shorter direction within the plane.
    """

    normals: Array
    weights: Array
    width_m: Array


def fit_planes(neighbours: Array) -> FittedPlanes:
    """Fit a plane through each group of points ``(M, K, 3)``.

    A hedge's points make no plane, and matching them as one pulls the scan in arbitrary directions: residuals were
    found to grow with the thickness ``d``, the root mean square distance of the neighbours from their plane. Their
    variance is taken as ``σ²·(1 + d²/τ²)``, so the weight, its inverse, is ``τ²/(τ² + d²)``, with ``τ`` = 15 cm.
    """
    from hybridlio.cloud import plane_loops  # late: compiled

    mean_squares, axes = plane_loops.principal_axes(np.ascontiguousarray(neighbours, np.float64))
    weights = _HALF_WEIGHT_THICKNESS_M**2 / (_HALF_WEIGHT_THICKNESS_M**2 + mean_squares[:, 0])
    return FittedPlanes(np.asarray(axes[:, :, 0]), np.asarray(weights), np.sqrt(mean_squares[:, 1]))


def span_several_rings(points: Array, neighbours: NDArray[np.uint64]) -> NDArray[np.bool_]:
    """Return which groups of neighbours contain points of more than one beam.

    A beam's points lie on a cone about the lidar's axis, so the plane through one ring is the cone's and not the
    surface's. On a distant wall it is horizontal, and the next scan's ring would be pulled to the height of this one.

    Args:
        points: ``(N, 3)``, lidar frame.
        neighbours: ``(M, K)`` indices of points.
    """
    from hybridlio.cloud import plane_loops  # late: compiled

    elevation_rad = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    others = plane_loops.far_from_median(elevation_rad, neighbours, _SAME_RING_RAD)
    return np.asarray(others >= _MIN_OTHER_RINGS)
