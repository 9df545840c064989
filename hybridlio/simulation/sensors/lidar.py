"""A spinning lidar: rays, first hits, and what the sensor reports of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Index, Stamps
from hybridlio.core.lidar_models import LidarModel
from hybridlio.core.sensors import NS_PER_S, Scan
from hybridlio.simulation.world.moving import MovingObject, in_reach
from hybridlio.simulation.world.rays import Hits, RayScene

# A return is detected if the received power, reflectance · cos(incidence) / range² (lidar equation of an extended,
# diffuse surface), exceeds a threshold. With this one asphalt is lost beyond about 60 m and a dark car beyond about
# 90 m, which is plausible for an HDL-64E. The standard deviation of its logarithm blurs these limits.
_THRESHOLD_1_M2 = 1.6e-6
_THRESHOLD_LOG_SIGMA = 0.35
FAINTEST_1_M2 = _THRESHOLD_1_M2 * float(np.exp(-3 * _THRESHOLD_LOG_SIGMA))
"""Received power below which a return is practically never detected."""
_MIN_RANGE_M = 1e-3  # keeps the power finite
_SHINE = (0.55, 0.45)  # share of the reported reflectance that is independent of incidence, and its cosine's share
_REFLECTANCE_SIGMA = 0.03  # of the reported reflectance: three of its hundredths
_MARGIN_RAD = 0.05  # 1.5 m (half a sweep at 30 m/s) seen at 30 m; nearer, the sphere is far larger than a car


@dataclass(frozen=True, eq=False)
class RayPattern:
    """The ``R`` rays of one turn of a lidar, beam by beam from the top.

    Attributes:
        directions: ``(R, 3)`` unit vectors in the lidar frame.
        column: ``(R,)`` azimuth step of each ray.
        column_offset_ns: ``(columns,)`` time of each azimuth step relative to the scan's stamp. The sensor turns
            counter-clockwise, starts and ends at the rear, and points forward at the stamp.
    """

    directions: Array
    column: Index
    column_offset_ns: Stamps

    def rays_near(self, centre: Array, radius_m: float) -> NDArray[np.intp]:
        """Return the rays that may hit a sphere about ``centre`` ``(3,)``, lidar frame, while it moves in a sweep."""
        columns, distance = len(self.column_offset_ns), float(np.hypot(centre[0], centre[1]))
        if columns == len(self.column):  # rays in no order of azimuth
            along, reach = self.directions @ centre, radius_m + _MARGIN_RAD * float(np.linalg.norm(centre))
            return np.flatnonzero((along > -reach) & (centre @ centre - along**2 < reach**2))
        if distance <= radius_m:
            return np.arange(len(self.column))
        middle = (np.arctan2(centre[1], centre[0]) / (2 * np.pi) + 0.5) * columns
        half = (np.arcsin(radius_m / distance) + _MARGIN_RAD) / (2 * np.pi) * columns
        window = np.unique(np.arange(int(middle - half), int(middle + half) + 1) % columns)
        rows = (np.arange(len(self.column) // columns)[:, None] * columns + window).reshape(-1)
        along = self.directions[rows] @ centre
        return np.asarray(rows[(along > 0) & (centre @ centre - along**2 < 1.5 * radius_m**2)])


def ray_pattern(model: LidarModel) -> RayPattern:
    """Return the rays of one turn of a lidar."""
    fraction = (np.arange(model.columns) + 0.5) / model.columns - 0.5
    azimuth = 2 * np.pi * fraction
    elevation = np.radians(model.elevations_deg)[:, None]
    flat = np.cos(elevation)
    parts = np.broadcast_arrays(flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation))
    offsets = np.round(fraction * NS_PER_S / model.rate_hz).astype(np.int64)
    column = np.broadcast_to(np.arange(model.columns), (model.beams, model.columns)).reshape(-1)
    return RayPattern(np.stack(parts, axis=-1).reshape(-1, 3), column, offsets)


def world_rays(pattern: RayPattern, poses: Array) -> tuple[Array, Array]:
    """Return origins and directions ``(R, 3)`` of a sweep's rays in world; poses as :func:`first_hits` takes them."""
    if len(poses) == 1:
        # einsum, because a matrix product starts threads, which cost more than so small a product
        directions = np.einsum("ij,rj->ri", poses[0, :3, :3], pattern.directions)
        return np.broadcast_to(poses[0, :3, 3], directions.shape), directions
    shape = (-1, len(poses), 3)
    directions = np.einsum("cij,bcj->bci", poses[:, :3, :3], pattern.directions.reshape(shape)).reshape(-1, 3)
    return np.tile(poses[:, :3, 3], (len(directions) // len(poses), 1)), directions


def first_hits(
    scene: RayScene, moving: Sequence[MovingObject], pattern: RayPattern, poses: Array, times_s: Array
) -> Hits:
    """Return the exact first hits of a sweep.

    Args:
        scene: everything that stands still, world frame.
        moving: everything that moves.
        pattern: the rays.
        poses: ``(columns, 4, 4)`` ``T_world_lidar`` at each azimuth step, or ``(1, 4, 4)`` for an instantaneous scan.
        times_s: ``(columns,)`` or ``(1,)``, the times of these poses.
    """
    instant = len(poses) == 1
    origins, directions = world_rays(pattern, poses)
    hits = scene.cast(origins, directions)
    middle = len(times_s) // 2
    for thing in in_reach(moving, poses[middle, :3, 3], float(times_s[middle])):
        T_world_thing = thing.poses(times_s)
        centre = se3.between(
            poses[middle], T_world_thing[middle] @ se3.make(np.eye(3), np.array([0, 0, thing.middle_m]))
        )
        rows = pattern.rays_near(centre[:3, 3], thing.radius_m)
        at = np.zeros(len(rows), np.int64) if instant else pattern.column[rows]
        R, t = T_world_thing[at, :3, :3], T_world_thing[at, :3, 3]
        local_origins = np.einsum("nji,nj->ni", R, origins[rows] - t)
        hits.take_nearer(rows, thing.scene.cast(local_origins, np.einsum("nji,nj->ni", R, directions[rows])))
    return hits


def measure(
    hits: Hits, pattern: RayPattern, model: LidarModel, stamp_ns: int, timed: bool, rng: np.random.Generator
) -> Scan:
    """Return the scan that the sensor reports of exact hits, with range noise, lost returns and reflectance noise.

    Args:
        hits: exact first hits of ``pattern``.
        pattern: the rays.
        model: the lidar.
        stamp_ns: the scan's stamp.
        timed: whether points get their times, as in a scan that needs motion compensation.
        rng: of the noise.
    """
    power = hits.reflectance * hits.cosine / np.maximum(hits.range_m, _MIN_RANGE_M) ** 2
    spread = np.float32(_THRESHOLD_LOG_SIGMA) * rng.standard_normal(len(power), dtype=np.float32)
    seen = (power > _THRESHOLD_1_M2 * np.exp(spread)) & (rng.random(len(power), dtype=np.float32) >= model.dropout)
    seen &= (hits.range_m >= model.min_range_m) & (hits.range_m <= model.max_range_m)
    rows = np.flatnonzero(seen)
    measured = hits.range_m[rows] + model.range_sigma_m * rng.standard_normal(len(rows))
    points = (pattern.directions[rows] * measured[:, None]).astype(np.float32)
    shine = hits.reflectance[rows] * (_SHINE[0] + _SHINE[1] * hits.cosine[rows])
    shine += _REFLECTANCE_SIGMA * rng.standard_normal(len(rows))
    offsets = pattern.column_offset_ns[pattern.column[rows]] if timed else None
    # KITTI reports reflectances in hundredths
    return Scan(stamp_ns, points, np.round(np.clip(shine, 0.0, 1.0), 2).astype(np.float32), offsets)
