"""A spinning lidar in the world: rays, returns, noise, and the sweep's motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.sensors import NS_PER_S, LidarModel, Scan
from hybridlio.simulation.drive.traffic import CAR_RADIUS_M, MovingCar, in_reach
from hybridlio.simulation.world.world import Hits, RayScene

# a return is seen where reflectance · cos(incidence) / range² is above this, give or take the spread of its logarithm:
# asphalt is then lost beyond 60 m or so, and a dark car beyond 90 m
_THRESHOLD_M2 = 1.6e-6
_THRESHOLD_SPREAD = 0.35
_INTENSITY_SIGMA = 0.03
_MARGIN_RAD = 0.05


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

    def rays_near(self, centre: Array, radius_m: float) -> NDArray[np.intp]:
        """The rays that may meet a sphere about ``centre`` ``(3,)``, lidar frame, with a margin for its motion."""
        columns, away = len(self.column_offset_ns), float(np.hypot(centre[0], centre[1]))
        if away <= radius_m:
            return np.arange(len(self.column))
        middle = (np.arctan2(centre[1], centre[0]) / (2 * np.pi) + 0.5) * columns
        half = (np.arcsin(radius_m / away) + _MARGIN_RAD) / (2 * np.pi) * columns
        window = np.unique(np.arange(int(middle - half), int(middle + half) + 1) % columns)
        rows = (np.arange(len(self.column) // columns)[:, None] * columns + window).reshape(-1)
        along = self.directions[rows] @ centre
        return np.asarray(rows[(along > 0) & (centre @ centre - along**2 < 1.5 * radius_m**2)])


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
        # not a matrix product: its threads cost more than the product of so small a matrix
        directions = np.einsum("ij,rj->ri", poses[0, :3, :3], pattern.directions)
        origins = np.broadcast_to(poses[0, :3, 3], directions.shape)
    else:
        shape = (-1, len(poses), 3)
        directions = np.einsum("cij,bcj->bci", poses[:, :3, :3], pattern.directions.reshape(shape)).reshape(-1, 3)
        origins = np.tile(poses[:, :3, 3], (len(directions) // len(poses), 1))
    hits = scene.cast(origins, directions)
    middle = len(times_s) // 2
    for car in in_reach(cars, poses[middle, :3, 3], float(times_s[middle])):
        T_world_car = car.poses(times_s)
        centre = se3.between(poses[middle], T_world_car[middle])[:3, 3] + [0.0, 0.0, 1.0]
        rows = pattern.rays_near(centre, CAR_RADIUS_M)
        at = np.zeros(len(rows), np.int64) if instant else pattern.column[rows]
        R, t = T_world_car[at, :3, :3], T_world_car[at, :3, 3]
        local_origins = np.einsum("nji,nj->ni", R, origins[rows] - t)
        hits.take_nearer(rows, car.scene.cast(local_origins, np.einsum("nji,nj->ni", R, directions[rows])))
    return hits


def measure(
    hits: Hits, pattern: RayPattern, model: LidarModel, stamp_ns: int, timed: bool, rng: np.random.Generator
) -> Scan:
    """What the sensor reports of exact hits: range noise, lost returns, reflectance in hundredths.

    ``timed`` gives every point its time, as a scan that needs motion compensation has.
    """
    power = hits.reflectance * hits.cosine / np.maximum(hits.range_m, 1e-3) ** 2
    spread = np.float32(_THRESHOLD_SPREAD) * rng.standard_normal(len(power), dtype=np.float32)
    seen = (power > _THRESHOLD_M2 * np.exp(spread)) & (rng.random(len(power), dtype=np.float32) >= model.dropout)
    seen &= (hits.range_m >= model.min_range_m) & (hits.range_m <= model.max_range_m)
    rows = np.flatnonzero(seen)
    measured = hits.range_m[rows] + model.range_sigma_m * rng.standard_normal(len(rows))
    points = (pattern.directions[rows] * measured[:, None]).astype(np.float32)
    shine = hits.reflectance[rows] * (0.55 + 0.45 * hits.cosine[rows])
    shine += _INTENSITY_SIGMA * rng.standard_normal(len(rows))
    offsets = pattern.column_offset_ns[pattern.column[rows]] if timed else None
    return Scan(stamp_ns, points, np.round(np.clip(shine, 0.0, 1.0), 2).astype(np.float32), offsets)
