"""A spinning lidar in the world: rays, returns, noise, and the sweep's motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridlio.sensors import NS_PER_S, LidarModel, Scan
from hybridlio.simulation.traffic import CAR_RADIUS_M, MovingCar, in_reach
from hybridlio.simulation.world import Hits, RayScene

Array = NDArray[np.float64]

# a return is seen where reflectance · cos(incidence) / range² is above this, give or take the spread of its logarithm:
# asphalt is then lost beyond 60 m or so, and a dark car beyond 90 m
_THRESHOLD_M2 = 1.6e-6
_THRESHOLD_SPREAD = 0.35
_INTENSITY_SIGMA = 0.03


@dataclass(frozen=True, eq=False)
class RayPattern:
    """One turn of a lidar, beam by beam from the top.

    Attributes:
        directions: ``(R, 3)`` unit vectors in the lidar frame.
        column: ``(R,)`` azimuth step of each ray.
        column_offset_ns: ``(columns,)`` time of each azimuth step relative to the scan's stamp. The sensor turns
            counter-clockwise, begins and ends at the rear, and looks ahead at the stamp.
    """

    directions: Array
    column: NDArray[np.int64]
    column_offset_ns: NDArray[np.int64]


def ray_pattern(model: LidarModel) -> RayPattern:
    """The rays of one turn of ``model``."""
    fraction = (np.arange(model.columns) + 0.5) / model.columns - 0.5
    azimuth = 2 * np.pi * fraction
    elevation = np.radians(model.elevations_deg)[:, None]
    flat = np.cos(elevation)
    parts = np.broadcast_arrays(flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation))
    offsets = np.round(fraction * NS_PER_S / model.rate_hz).astype(np.int64)
    column = np.broadcast_to(np.arange(model.columns), (model.beams, model.columns)).reshape(-1)
    return RayPattern(np.stack(parts, axis=-1).reshape(-1, 3), column, offsets)


def first_hits(scene: RayScene, cars: Sequence[MovingCar], pattern: RayPattern, poses: Array, times_s: Array) -> Hits:
    """Exact first hits of a sweep.

    Args:
        scene: everything that stands still, in world coordinates.
        cars: everything that moves.
        pattern: the rays.
        poses: ``(columns, 4, 4)`` ``T_world_lidar`` at each azimuth step, or ``(1, 4, 4)`` for an instant.
        times_s: ``(columns,)`` or ``(1,)`` the times of these poses.
    """
    instant = len(poses) == 1
    if instant:
        directions = pattern.directions @ poses[0, :3, :3].T
        origins = np.broadcast_to(poses[0, :3, 3], directions.shape)
    else:
        shape = (-1, len(poses), 3)
        directions = np.einsum("cij,bcj->bci", poses[:, :3, :3], pattern.directions.reshape(shape)).reshape(-1, 3)
        origins = np.tile(poses[:, :3, 3], (len(directions) // len(poses), 1))
    hits = scene.cast(origins, directions)
    middle = len(times_s) // 2
    for car in in_reach(cars, poses[middle, :3, 3], float(times_s[middle])):
        column = np.zeros(len(directions), np.int64) if instant else pattern.column
        hits = _with_car(hits, car, origins, directions, column, times_s)
    return hits


def _with_car(
    hits: Hits, car: MovingCar, origins: Array, directions: Array, column: NDArray[np.int64], times_s: Array
) -> Hits:
    """The hits, or the moving car's where it is nearer: its rays are cast in its own frame, at each ray's time."""
    T_world_car = car.poses(times_s)
    towards = T_world_car[len(times_s) // 2, :3, 3] + [0.0, 0.0, 1.0] - origins[0]
    along = directions @ towards
    beside_squared = towards @ towards - along**2
    near = np.flatnonzero((along > 0) & (beside_squared < CAR_RADIUS_M**2))
    if not len(near):
        return hits
    R, t = T_world_car[column[near], :3, :3], T_world_car[column[near], :3, 3]
    local_origins = np.einsum("nji,nj->ni", R, origins[near] - t)
    found = car.scene.cast(local_origins, np.einsum("nji,nj->ni", R, directions[near]))
    closer = found.range_m < hits.range_m[near]
    rows = near[closer]
    merged = Hits(hits.range_m.copy(), hits.cosine.copy(), hits.reflectance.copy())
    merged.range_m[rows], merged.cosine[rows] = found.range_m[closer], found.cosine[closer]
    merged.reflectance[rows] = found.reflectance[closer]
    return merged


def measure(
    hits: Hits, pattern: RayPattern, model: LidarModel, stamp_ns: int, timed: bool, rng: np.random.Generator
) -> Scan:
    """What the sensor reports of exact hits: range noise, lost returns, reflectance in hundredths.

    ``timed`` gives every point its time, as a scan that needs motion compensation has.
    """
    power = hits.reflectance * hits.cosine / np.maximum(hits.range_m, 1e-3) ** 2
    threshold = _THRESHOLD_M2 * np.exp(_THRESHOLD_SPREAD * rng.standard_normal(len(power)))
    seen = (power > threshold) & (rng.random(len(power)) >= model.dropout)
    seen &= (hits.range_m >= model.min_range_m) & (hits.range_m <= model.max_range_m)
    rows = np.flatnonzero(seen)
    measured = hits.range_m[rows] + model.range_sigma_m * rng.standard_normal(len(rows))
    points = (pattern.directions[rows] * measured[:, None]).astype(np.float32)
    shine = hits.reflectance[rows] * (0.55 + 0.45 * hits.cosine[rows])
    shine += _INTENSITY_SIGMA * rng.standard_normal(len(rows))
    offsets = pattern.column_offset_ns[pattern.column[rows]] if timed else None
    return Scan(stamp_ns, points, np.round(np.clip(shine, 0.0, 1.0), 2).astype(np.float32), offsets)
