"""Ground: the plane under the sensor by RANSAC, and the points that lie on it.

Source: UnDeepLIO, "Loss Function": ground points are removed by RANSAC (Fischler and Bolles, 1981) before voxel
averaging. Planes are drawn from points below the sensor; those steeper than a slope a vehicle stands on are dropped
before anything is counted, which leaves few to score; drawing stops once a better plane is unlikely.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridlio.core.arrays import Array, Mask
from hybridlio.core.errors import ConfigError, DataError


@dataclass(frozen=True)
class GroundOptions:
    """How ground is looked for.

    Attributes:
        threshold_m: points nearer than this to the plane are ground.
        max_slope_deg: the plane's largest tilt against the sensor's x-y plane; 10° of road and the pitch of a vehicle.
        min_share: ground is found when the plane holds at least this share of all points.
        samples: so many points score a plane, and at most so many planes are drawn.
        confidence: probability that the best plane has been drawn when drawing stops.
        seed: of the draws; the same cloud gives the same ground.
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
    """The ground found in a cloud: ``normal · p + offset_m = 0``.

    Attributes:
        normal: ``(3,)`` unit, pointing up; zero where no ground was found.
        offset_m: height of the sensor above the plane; 0 where no ground was found.
        mask: ``(N,)`` bool, the points that are ground; all False where none was found.
    """

    normal: Array
    offset_m: float
    mask: Mask = field(repr=False)

    @property
    def found(self) -> bool:
        """Whether there is ground."""
        return bool(self.normal.any())


def find_ground(
    points: ArrayLike, normals: ArrayLike | None = None, options: GroundOptions | None = None
) -> GroundPlane:
    """The ground plane under the sensor, and the points on it.

    Where the cloud shows no ground (too few points on any plane, points spread evenly through the slab instead of
    lying on its middle, or all in one line) the mask is all False.

    Args:
        points: ``(N, 3)`` metres, lidar frame with z up, the sensor in the origin above the ground.
        normals: ``(N, 3)`` or None. With them only points whose surface is level enough propose a plane, which finds
            the ground where there is little of it among walls.
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
    """The points ``(M, 3)`` that are not ground; arguments and errors as :func:`find_ground`."""
    points = np.asarray(points, dtype=np.float32)
    return points[~find_ground(points, normals, options).mask]


def _candidates(points: NDArray[np.float32], normals: ArrayLike | None, options: GroundOptions) -> Mask:
    """Finite points below the sensor, on level surfaces where normals tell."""
    below = np.isfinite(points).all(axis=1) & (points[:, 2] < 0)
    if normals is None:
        return below
    normals = np.asarray(normals, dtype=np.float32)
    if normals.shape != points.shape:
        raise DataError(f"ground: normals {normals.shape} do not go with points {points.shape}; give one a point")
    level = np.cos(np.radians(min(options.max_slope_deg + 15.0, 89.0)))  # normals are noisier than the plane
    return np.asarray(below & (np.abs(normals[:, 2]) > level))


def _heights(plane: Array, points: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(points @ plane[:3].astype(np.float32) + np.float32(plane[3]))


def _draw_plane(points: NDArray[np.float32], rng: np.random.Generator, options: GroundOptions) -> Array | None:
    """The plane through three of the points that most of them lie near; None where all are too steep."""
    planes = _planes_through(points[rng.integers(0, len(points), (options.samples, 3))], options)
    best, most, batch = None, 0, 64
    for start in range(0, len(planes), batch):
        some = planes[start : start + batch].astype(np.float32)
        near = np.count_nonzero(np.abs(some[:, :3] @ points.T + some[:, 3:]) < options.threshold_m, axis=1)
        if near.max() > most:
            most, best = int(near.max()), planes[start + int(near.argmax())]
        # probability that no draw so far had three points of the best plane; dropped draws count as draws too
        share = (most / len(points)) ** 3
        drawn = options.samples * min(start + batch, len(planes)) / len(planes)
        if drawn * np.log1p(-min(share, 1 - 1e-12)) < np.log(1 - options.confidence):
            break
    return best


def _planes_through(corners: NDArray[np.float32], options: GroundOptions) -> Array:
    """Planes ``(M, 4)`` through triples of points that are level enough and below the sensor; normals point up."""
    a, b, c = np.moveaxis(corners.astype(np.float64), 1, 0)
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    steep = np.abs(normal[:, 2]) < np.cos(np.radians(options.max_slope_deg)) * length
    normal, a = normal[~steep & (length > 1e-6)], a[~steep & (length > 1e-6)]
    normal *= np.sign(normal[:, 2:]) / np.linalg.norm(normal, axis=1, keepdims=True)
    offset = -np.einsum("ij,ij->i", normal, a)
    return np.asarray(np.column_stack([normal, offset])[offset > 0])


def _refine(plane: Array, points: NDArray[np.float32], options: GroundOptions) -> Array | None:
    """The plane of least squares through the points near it, or None where they do not look like ground."""
    near = points[np.abs(_heights(plane, points)) < options.threshold_m].astype(np.float64)
    for _ in range(3):
        if len(near) < 3:
            return None
        centre = near.mean(axis=0)
        spread, axes = np.linalg.eigh((near - centre).T @ (near - centre) / len(near))
        normal = axes[:, 0] * np.sign(axes[2, 0] or 1.0)
        plane = np.append(normal, -normal @ centre)
        near = points[np.abs(_heights(plane, points)) < options.threshold_m].astype(np.float64)
    line = spread[1] < max(4 * spread[0], options.threshold_m**2)
    # a slab cut out of something tall is filled evenly (standard deviation t/√3); ground gathers in its middle
    even = spread[0] > (0.5 * options.threshold_m) ** 2
    steep = plane[2] < np.cos(np.radians(options.max_slope_deg))
    return None if line or even or steep or plane[3] <= 0 else plane
