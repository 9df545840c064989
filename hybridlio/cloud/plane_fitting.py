"""Planes through points of a scan and their neighbours, by their directions of least spread, and what each is worth."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridlio.core.arrays import Array

LEAST_NEIGHBOURS = 5  # that make a plane; small_gicp, too, fits none to fewer
_THIN_M = 0.15  # so thick a plane counts half
_RING_RAD = np.deg2rad(0.1)  # beams of spinning lidars are 0.3° apart and more
_LEAST_OF_OTHERS = 2  # of ten


class Planes(NamedTuple):
    """Points with the planes about them, map frame.

    Attributes:
        points, normals: ``(M, 3)`` each.
        weights: ``(M,)``, how much each plane counts.
    """

    points: Array
    normals: Array
    weights: Array


class Fitted(NamedTuple):
    """Planes fitted to so many neighbours each.

    Attributes:
        normals: ``(M, 3)`` directions of least spread.
        weights: ``(M,)``, the less the thicker.
        breadth_m: ``(M,)`` root mean square along the direction in the plane in which the neighbours spread less.
    """

    normals: Array
    weights: Array
    breadth_m: Array


def fit_planes(near: Array) -> Fitted:
    """A plane through each of the groups of points ``(M, K, 3)``.

    A hedge's points make no plane, and pull a scan anywhere: what a scan's points lie off planes was seen to grow with
    their thickness, the root mean square along the normal. On simulated drives weights by the inverse square of that
    are the best (half at 3 cm); with real scans and poses so narrow a choice makes paths longer than they are.
    """
    near = near - near.mean(axis=1, keepdims=True)
    spread, axes = np.linalg.eigh(near.transpose(0, 2, 1) @ near)
    spread2 = np.maximum(spread, 0.0) / near.shape[1]
    weights = _THIN_M**2 / (_THIN_M**2 + spread2[:, 0])
    return Fitted(np.asarray(axes[:, :, 0]), np.asarray(weights), np.sqrt(spread2[:, 1]))


def of_several_rings(points: Array, near: NDArray[np.uint64]) -> NDArray[np.bool_]:
    """Whether those of the points ``(N, 3)``, lidar frame, that ``near`` ``(M, K)`` numbers are of more than one beam.

    One beam's points lie on a cone about the lidar's axis: whatever it hits, their plane is the cone's. On a far wall
    its normal stands upright, and the next scan's ring would be pulled to the height of this one's.
    """
    elevation_rad = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    beams_rad = np.sort(elevation_rad[near], axis=1)
    count = beams_rad.shape[1]
    middle_rad = (beams_rad[:, (count - 1) // 2] + beams_rad[:, count // 2]) / 2  # np.median takes three times as long
    others = np.abs(beams_rad - middle_rad[:, None]) > _RING_RAD
    return np.asarray(others.sum(axis=1) >= _LEAST_OF_OTHERS)
