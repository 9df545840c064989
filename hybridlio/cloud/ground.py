"""Ground segmentation: find the plane under the sensor by RANSAC, and the points on it.

Source: UnDeepLIO, "Loss Function": ground points are removed by RANSAC (Fischler and Bolles, 1981) before voxel
averaging. Candidate planes go through three points below the sensor. Those too steep for a vehicle to stand on are
dropped before inliers are counted, which leaves few to score, and scoring stops once a better plane is unlikely.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridlio.core.arrays import Array, Mask
from hybridlio.core.errors import ConfigError, DataError

_NORMAL_MARGIN_DEG = 15.0  # on the slope, for single points: their normals are noisier than a plane through many
_MAX_LEVEL_DEG = 89.0  # keeps the cosine positive for steep slopes
_BATCH = 64  # planes scored between two checks for stopping; one matrix product each
_REFINEMENTS = 3  # least-squares fits to the inliers; the inliers hardly change after the second
# Ground points gather in the middle of the slab of ±threshold, those of something tall fill it evenly, with a standard
# deviation of threshold/√3 = 0.58 thresholds.
_MAX_SPREAD_RATIO = 0.5
_MIN_WIDTH_RATIO = 4.0  # variance across a line of points over that along its normal; below it they make no plane
_MIN_DOUBLE_AREA_M2 = 1e-6  # of the triangle of three points; with less they are on a line


@dataclass(frozen=True)
class GroundOptions:
    """Settings of the ground segmentation.

    Attributes:
        threshold_m: points nearer than this to the plane are ground.
        max_slope_deg: largest tilt of the plane against the sensor's x-y plane: 10° of road, and the vehicle's pitch.
        min_share: ground is found only if at least this share of all points lies on the plane.
        samples: largest number of points that score a plane, and of planes that are drawn.
        confidence: probability at which the best plane has been drawn when drawing stops.
        seed: of the random draws; the same cloud always gives the same ground.
    """

    threshold_m: float = 0.2
    max_slope_deg: float = 15.0
    min_share: float = 0.03
    samples: int = 4096
    confidence: float = 0.999
    seed: int = 0

    def __post_init__(self) -> None:
        if not (self.threshold_m > 0 and 0 < self.max_slope_deg < 90 and 0 <= self.min_share <= 1):
            raise ConfigError(
                f"ground: threshold_m, max_slope_deg (below 90) or min_share (0 to 1) out of range: {self}"
            )
        if self.samples < 3 or not 0 < self.confidence < 1:
            raise ConfigError(f"ground: samples must be 3 or more and confidence between 0 and 1: {self}")


@dataclass(frozen=True, eq=False)
class GroundPlane:
    """The ground plane ``normal · p + offset_m = 0`` of a cloud.

    Attributes:
        normal: ``(3,)`` unit vector pointing up; zero if no ground was found.
        offset_m: height of the sensor above the plane; 0 if no ground was found.
        mask: ``(N,)`` bool, True for ground points.
    """

    normal: Array
    offset_m: float
    mask: Mask = field(repr=False)

    @property
    def found(self) -> bool:
        """Whether ground was found."""
        return bool(self.normal.any())


def find_ground(
    points: ArrayLike, normals: ArrayLike | None = None, options: GroundOptions | None = None
) -> GroundPlane:
    """Find the ground plane under the sensor, and the points on it.

    No ground is found if too few points lie on any plane, if they fill the slab around the plane evenly instead of
    gathering in its middle, or if they lie on one line.

    Args:
        points: ``(N, 3)`` metres, lidar frame with z up, the sensor in the origin above the ground.
        normals: ``(N, 3)`` or None. If given, planes are drawn from points with a level surface only, which helps where
            little ground is visible between walls.
        options: limits, and the seed.

    Raises:
        DataError: points are not ``(N, 3)``, or normals differ in shape.
    """
    options = options or GroundOptions()
    points = np.asarray(points, dtype=np.float32)
    if points.ndim != 2 or points.shape[1] != 3:
        raise DataError(f"ground: points must be (N, 3), got {points.shape}")
    nothing = GroundPlane(np.zeros(3), 0.0, np.zeros(len(points), bool))
    candidates = points[_candidates(points, normals, options)]
    rng = np.random.default_rng(options.seed)
    if len(candidates) > options.samples:
        candidates = candidates[rng.choice(len(candidates), options.samples, replace=False)]
    if len(candidates) < 3:
        return nothing
    plane = _draw_plane(candidates, rng, options)
    if plane is not None:
        plane = _refine(plane, candidates, options)
    if plane is None:
        return nothing
    mask = np.abs(_heights(plane, points)) < options.threshold_m
    if np.count_nonzero(mask) < max(options.min_share * len(points), 3):
        return nothing
    return GroundPlane(plane[:3], float(plane[3]), mask)


def remove_ground(
    points: ArrayLike, normals: ArrayLike | None = None, options: GroundOptions | None = None
) -> NDArray[np.float32]:
    """Return the points ``(M, 3)`` that are not ground; arguments and errors are those of :func:`find_ground`."""
    points = np.asarray(points, dtype=np.float32)
    return points[~find_ground(points, normals, options).mask]


def _candidates(points: NDArray[np.float32], normals: ArrayLike | None, options: GroundOptions) -> Mask:
    """Return which points are finite, below the sensor, and on a level surface if normals are given."""
    below = np.isfinite(points).all(axis=1) & (points[:, 2] < 0)
    if normals is None:
        return below
    normals = np.asarray(normals, dtype=np.float32)
    if normals.shape != points.shape:
        raise DataError(
            f"ground: normals have shape {normals.shape} and points {points.shape}; give one normal per point"
        )
    level = np.cos(np.radians(min(options.max_slope_deg + _NORMAL_MARGIN_DEG, _MAX_LEVEL_DEG)))
    return np.asarray(below & (np.abs(normals[:, 2]) > level))


def _heights(plane: Array, points: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(points @ plane[:3].astype(np.float32) + np.float32(plane[3]))


def _draw_plane(points: NDArray[np.float32], rng: np.random.Generator, options: GroundOptions) -> Array | None:
    """Return the plane through three points with the most inliers; None if all planes are too steep."""
    planes = _planes_through(points[rng.integers(0, len(points), (options.samples, 3))], options)
    best, most = None, 0
    for start in range(0, len(planes), _BATCH):
        some = planes[start : start + _BATCH].astype(np.float32)
        near = np.count_nonzero(np.abs(some[:, :3] @ points.T + some[:, 3:]) < options.threshold_m, axis=1)
        if near.max() > most:
            most, best = int(near.max()), planes[start + int(near.argmax())]
        # RANSAC's stopping rule: probability that no draw so far had three inliers; steep planes were draws, too
        share = (most / len(points)) ** 3
        drawn = options.samples * min(start + _BATCH, len(planes)) / len(planes)
        if drawn * np.log1p(-min(share, 1 - 1e-12)) < np.log(1 - options.confidence):
            break
    return best


def _planes_through(corners: NDArray[np.float32], options: GroundOptions) -> Array:
    """Return the planes ``(M, 4)`` through triples of points that are level and below the sensor; normals point up."""
    a, b, c = np.moveaxis(corners.astype(np.float64), 1, 0)
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    steep = np.abs(normal[:, 2]) < np.cos(np.radians(options.max_slope_deg)) * length
    normal, a = normal[~steep & (length > _MIN_DOUBLE_AREA_M2)], a[~steep & (length > _MIN_DOUBLE_AREA_M2)]
    normal *= np.sign(normal[:, 2:]) / np.linalg.norm(normal, axis=1, keepdims=True)
    offset = -np.einsum("ij,ij->i", normal, a)
    return np.asarray(np.column_stack([normal, offset])[offset > 0])


def _refine(plane: Array, points: NDArray[np.float32], options: GroundOptions) -> Array | None:
    """Return the least-squares plane through the inliers, or None if they do not look like ground."""
    near = points[np.abs(_heights(plane, points)) < options.threshold_m].astype(np.float64)
    for _ in range(_REFINEMENTS):
        if len(near) < 3:
            return None
        centre = near.mean(axis=0)
        spread, axes = np.linalg.eigh((near - centre).T @ (near - centre) / len(near))
        normal = axes[:, 0] * np.sign(axes[2, 0] or 1.0)
        plane = np.append(normal, -normal @ centre)
        near = points[np.abs(_heights(plane, points)) < options.threshold_m].astype(np.float64)
    is_line = spread[1] < max(_MIN_WIDTH_RATIO * spread[0], options.threshold_m**2)
    is_even = spread[0] > (_MAX_SPREAD_RATIO * options.threshold_m) ** 2
    is_steep = plane[2] < np.cos(np.radians(options.max_slope_deg))
    return None if is_line or is_even or is_steep or plane[3] <= 0 else plane
