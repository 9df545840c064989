"""The plan of a drive, from its settings: the path, the world along it, and the traffic."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from hybridlio.core.arrays import Array
from hybridlio.simulation.config import SimulationConfig
from hybridlio.simulation.drive.dust import dust_clouds
from hybridlio.simulation.drive.path import SmoothPath
from hybridlio.simulation.drive.pose_files import path_along, read_lidar_poses
from hybridlio.simulation.drive.revisits import level_revisits
from hybridlio.simulation.drive.rises import without_false_rises
from hybridlio.simulation.drive.traffic import EgoDrive, traffic
from hybridlio.simulation.drive.vehicle import FINE_S, drive_path, lane_of
from hybridlio.simulation.random_streams import RandomStream
from hybridlio.simulation.rig import LIDAR_HEIGHT_M, SCAN_RATE_HZ, T_IMU_LIDAR
from hybridlio.simulation.sensors.air import CLEAR, Air
from hybridlio.simulation.world.ground import CAMBER, Ground, Height, land_along, waves
from hybridlio.simulation.world.layout import lay_out
from hybridlio.simulation.world.moving import MovingObject
from hybridlio.simulation.world.roads import LANE_OFFSET_M, MANNERS, STEP_M, Road, drive, generate_centreline
from hybridlio.simulation.world.world import World

DEFAULT_SECONDS = 60.0  # time for several bends and stops, and for two round trips
_MARGIN_S = 1.0  # of the path before and after the scans, for the IMU's lead and the spline's ends
_BEHIND_M, _AHEAD_M = 70.0, 130.0  # road and town before the start and after the end: as far as the lidar sees them
_LENGTH_RESERVE = 1.1  # of the road over the distance at cruising speed
_SLOWEST, _LONGEST_STOPS_S = 0.25, 60.0  # mean speed relative to cruising, and time in stops, that a drive allows for
_MIN_SECONDS = 0.2  # two scans
_LANE_SIGMA_M = 3.0  # smooths the lane below a recorded path, whose points may be noisy
_STRETCHES = (1.0, 1.3, 1.7, 2.2)  # factors of the road's length that are tried until the drive fits
_ROUND_TRIP_SHARE = 0.25  # of the length: with bends and stops, two round trips fit in any drive of a minute
_ROUND_TRIP_M = (220.0, 700.0)  # two blocks of houses
_EGO_STEP_S = 0.1  # of the ego car's positions that traffic is checked against
# Unevenness as sums of 24 waves: lengths in m, rms slope. Land: plausible hills. Bumps and cracks of the road: the
# slopes of a good road (below 1 %). Unpaved ground: knee-high.
_LAND, _CORRIDOR_SHARE = (12, (90.0, 500.0), 0.025), 0.3
_ROUGHNESS, _BUMPS, _CRACKS = (24, (1.2, 6.0), 0.05), (24, (5.0, 25.0), 0.008), (24, (1.5, 5.0), 0.008)


@dataclass(frozen=True, eq=False)
class Drive:
    """A planned drive.

    Attributes:
        path: of the IMU, from a second before time zero to a second after the last scan.
        scan_times_s: ``(N,)`` times of the scans' stamps, from zero.
        world: everything that stands still.
        cars: everything that moves, except the recording car.
        air: rain and dust.
    """

    path: SmoothPath
    scan_times_s: Array
    world: World
    cars: list[MovingObject]
    air: Air = CLEAR


def plan(config: SimulationConfig) -> Drive:
    """Plan the drive that ``config`` describes; the same settings give the same drive.

    Raises:
        ConfigError: there is no such pose file.
        DataError: the pose file is malformed.
    """
    return _along_poses(config) if config.poses is not None else _along_generated_road(config)


def _ground(land: Height, centreline: Road, config: SimulationConfig) -> Ground:
    """Return the ground of a road on ``land``."""
    rng = np.random.default_rng([config.seed, RandomStream.GROUND])
    points = centreline.at(np.arange(0.0, centreline.length_m, STEP_M))
    roughness = waves(rng, *_ROUGHNESS)
    bumps, cracks = waves(rng, *_BUMPS), waves(rng, *_CRACKS)
    return Ground(land, roughness, lambda xy: bumps(xy) + cracks(xy), cKDTree(points), curbs=config.scene == "town")


def _along_generated_road(config: SimulationConfig) -> Drive:
    """Plan a drive along a generated road, which is made longer until the drive fits."""
    seconds = config.seconds or DEFAULT_SECONDS
    length = config.length_m or _LENGTH_RESERVE * config.speed_m_s * (seconds + 2 * _MARGIN_S)
    most = length / (_SLOWEST * config.speed_m_s) + _LONGEST_STOPS_S if config.length_m else seconds
    margin = round(_MARGIN_S / FINE_S)
    ticks = np.arange(-margin, round((most + _MARGIN_S) / FINE_S) + 1)
    times = np.asarray(ticks * FINE_S, dtype=np.float64)
    for stretch in _STRETCHES:
        centreline, lane, ground, s = _driven(config, length, stretch, times)
        driven = s - s[margin]
        if (driven[-1] > config.length_m) if config.length_m else (s[-1] < lane.length_m - STEP_M):
            break
    if config.length_m:
        last = min(int(np.searchsorted(driven, config.length_m)), len(times) - margin - 1)
        seconds = max(float(times[last]), _MIN_SECONDS)
    used = slice(0, round((seconds + 2 * _MARGIN_S) / FINE_S) + 1)
    path = drive_path(lane, s[used], times[used], ground)
    return _with_world(config, path, centreline, lane, ground, seconds)


def _driven(config: SimulationConfig, length: float, stretch: float, times: Array) -> tuple[Road, Road, Ground, Array]:
    """Return a road, its right-hand lane, the ground, and the arc length on the lane at ``times``.

    ``length`` is the distance to drive. Rounded corners shorten the road by an amount that depends on its bends;
    ``stretch`` makes it longer.
    """
    rng = np.random.default_rng([config.seed, RandomStream.ROAD])
    round_trip = float(np.clip(_ROUND_TRIP_SHARE * length, *_ROUND_TRIP_M)) if config.loops else None
    centreline = generate_centreline(rng, stretch * length + _BEHIND_M + _AHEAD_M, config.scene, round_trip)
    count, lengths, slope = _LAND
    flat = _CORRIDOR_SHARE if config.scene == "corridor" else 1.0
    land = waves(np.random.default_rng([config.seed, RandomStream.LAND]), count, lengths, slope * flat)
    ground = _ground(land, centreline, config)
    if not config.is_first_drive:  # the road is the town's, the driver another one
        rng = np.random.default_rng([config.own_seed, RandomStream.ROAD])
    lane = lane_of(centreline, rng)
    manner = MANNERS[config.driving]
    s = _BEHIND_M + drive(lane, _BEHIND_M, config.speed_m_s, times, config.start_moving, rng, manner)
    return centreline, lane, ground, s


def _along_poses(config: SimulationConfig) -> Drive:
    """Plan a drive along a pose file, with heights corrected, on land that passes below it."""
    recorded = read_lidar_poses(config.require_poses(), config.poses_frame)
    lidar_poses = level_revisits(without_false_rises(recorded))
    path = path_along(lidar_poses)
    seconds = len(lidar_poses) / SCAN_RATE_HZ
    if config.length_m is not None:
        driven = np.cumsum(np.linalg.norm(np.diff(lidar_poses[:, :3, 3], axis=0), axis=1))
        seconds = min(seconds, (float(np.searchsorted(driven, config.length_m)) + 1) / SCAN_RATE_HZ)
    seconds = min(seconds, config.seconds or np.inf)
    lidar = path.poses(np.arange(path.start_s, path.end_s, _EGO_STEP_S)) @ T_IMU_LIDAR
    below = lidar[:, :3, 3] - LIDAR_HEIGHT_M * lidar[:, :3, 2]
    lane = _road_below(below[:, :2], lidar[:, :2, 0])
    centreline = Road.through(lane.beside(np.arange(0.0, lane.length_m, STEP_M), LANE_OFFSET_M))
    land = land_along(below + np.array([0.0, 0.0, CAMBER * LANE_OFFSET_M]))
    return _with_world(config, path, centreline, lane, _ground(land, centreline, config), seconds)


def _road_below(points: Array, ahead: Array) -> Road:
    """Return the lane of a car that was at ``points`` ``(N, 2)`` and may have stood, extended at both ends.

    ``ahead`` ``(N, 2)`` is the car's direction.
    """
    kept = [0]
    for i in range(1, len(points)):
        if np.linalg.norm(points[i] - points[kept[-1]]) > STEP_M:
            kept.append(i)
    ahead = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
    back = points[0] - np.arange(_BEHIND_M, 0.0, -STEP_M)[:, None] * ahead[0]
    on = points[kept[-1]] + np.arange(STEP_M, _AHEAD_M, STEP_M)[:, None] * ahead[kept[-1]]
    rough = np.concatenate([back, points[kept], on])
    dense = Road.through(rough)
    even = dense.at(np.arange(0.0, dense.length_m, STEP_M))
    return Road.through(gaussian_filter1d(even, _LANE_SIGMA_M / STEP_M, axis=0, mode="nearest"))


def _with_world(
    config: SimulationConfig, path: SmoothPath, centreline: Road, lane: Road, ground: Ground, seconds: float
) -> Drive:
    """Return a drive of ``seconds`` along ``path``, with objects and traffic."""
    items = lay_out(
        centreline,
        ground.centre,
        config.scene,
        config.parked,
        np.random.default_rng([config.seed, RandomStream.LAYOUT]),
        None if config.is_first_drive else np.random.default_rng([config.own_seed, RandomStream.LAYOUT]),
    )
    scans = np.arange(max(round(seconds * SCAN_RATE_HZ), 2)) / SCAN_RATE_HZ
    times = np.arange(-0.5, scans[-1] + 0.6, _EGO_STEP_S)
    ego_xy = path.poses(times)[:, :2, 3]
    ego = EgoDrive(lane, times, _arc_length_of(lane, ego_xy), ego_xy)
    cars = traffic(centreline, ego, ground, config.traffic_per_km, config.own_seed)
    dust = dust_clouds(ego, ground, config.dust_per_km, config.own_seed) if config.dust_per_km else None
    return Drive(path, scans, World(ground, items, config.seed), cars, Air(config.rain_mm_h, dust))


def _arc_length_of(lane: Road, xy: Array) -> Array:
    """Return the arc length ``(N,)`` of successive positions: the first by search, the others by distance driven.

    A search for each would fail where the lane crosses itself.
    """
    start = int(np.argmin(np.linalg.norm(lane.at(np.arange(0.0, 2 * _BEHIND_M, STEP_M)) - xy[0], axis=1))) * STEP_M
    steps = np.concatenate([[0.0], np.linalg.norm(np.diff(xy, axis=0), axis=1)])
    return np.asarray(np.minimum(start + np.cumsum(steps), lane.length_m))
