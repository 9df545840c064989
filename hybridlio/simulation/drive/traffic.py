"""Moving cars: oncoming ones, and ones ahead of and behind the recording car (the ego car)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from hybridlio.core.arrays import Array
from hybridlio.simulation.random_streams import RandomStream
from hybridlio.simulation.world import street
from hybridlio.simulation.world.ground import Ground
from hybridlio.simulation.world.moving import MovingObject
from hybridlio.simulation.world.roads import LANE_OFFSET_M, Road

_CAR_RADIUS_M = 5.5  # of a sphere about a car's middle that contains the longest, a lorry of 9 m
_CAR_MIDDLE_M = 1.0
_CLEARANCE_M = 3.0  # between the middles of two cars that pass, at least: lanes are 3.5 m apart
_SENSORS_M = 0.5  # the ego car's sensors are within this of its IMU
# Plausible for a town; this is not a traffic model.
_ONCOMING_SHARE = 0.7  # these meet the ego car, the others keep their distance to it
_MIN_MEAN_SPEED_M_S = 4.0  # of others, also where the ego car creeps
_MIN_SAMPLES = 10  # a car that is on the road for less than a second (10 Hz) is left out


def moving_car(motion: CubicSpline, shape_seed: tuple[int, int]) -> MovingObject:
    """Return a car or lorry with a motion ``(x, y, z, heading)``."""
    return MovingObject(motion, shape_seed, street.car, _CAR_MIDDLE_M, _CAR_RADIUS_M)


@dataclass(frozen=True, eq=False)
class EgoDrive:
    """Where the ego car is over time.

    Attributes:
        lane: the line that it follows.
        times_s: ``(N,)``, every 0.1 s.
        s: ``(N,)`` arc length on the lane.
        xy: ``(N, 2)`` position of the IMU, world frame.
    """

    lane: Road
    times_s: Array
    s: Array
    xy: Array


def traffic(centreline: Road, ego: EgoDrive, ground: Ground, per_km: float, seed: int) -> list[MovingObject]:
    """Draw the moving cars of a drive.

    Seven in ten are oncoming, the others stay some seconds ahead or behind. Cars that would come too near to the ego
    car, where the road crosses itself, are left out.

    Args:
        centreline: of the road.
        ego: the ego car's drive.
        ground: on which the cars drive.
        per_km: cars per kilometre.
        seed: of the drive.
    """
    rng = np.random.default_rng([seed, RandomStream.TRAFFIC])
    cars = []
    times_s = ego.times_s
    driven = float(ego.s[-1] - ego.s[0])
    mean_speed = max(driven / float(times_s[-1] - times_s[0]), _MIN_MEAN_SPEED_M_S)
    for number in range(rng.poisson(per_km * (2 * driven + 200.0) / 1000.0)):
        if rng.random() < _ONCOMING_SHARE:
            speed = mean_speed * rng.uniform(0.7, 1.3)
            meeting = float(ego.s[0]) + rng.uniform(-50.0, 2 * driven + 150.0)
            motion = _motion(centreline, meeting - speed * times_s, LANE_OFFSET_M, times_s, ground)
        else:
            shifted = times_s + rng.choice([-1, 1]) * rng.uniform(2.0, 6.0)
            s = np.where((shifted > times_s[0]) & (shifted < times_s[-1]), np.interp(shifted, times_s, ego.s), -1.0)
            motion = _motion(ego.lane, s, 0.0, times_s, ground)
        car = None if motion is None else moving_car(motion, (seed, 1000 + number))
        if car is not None and _keeps_clear(car, ego):
            cars.append(car)
    return cars


def _motion(road: Road, s: Array, left_m: float, times_s: Array, ground: Ground) -> CubicSpline | None:
    """Return position, height and heading while ``s`` is on the road; None if that is too short.

    ``left_m`` is the distance to the left of the road's line; a car on the left drives the other way.
    """
    on_road = (s > 1.0) & (s < road.length_m - 1.0)
    if on_road.sum() < _MIN_SAMPLES:
        return None
    s, times_s = s[on_road], times_s[on_road]
    xy = road.beside(s, left_m)
    heading = np.unwrap(road.heading(s) + (np.pi if left_m > 0 else 0.0))
    return CubicSpline(times_s, np.column_stack([xy, ground.height(xy), heading]))


def _keeps_clear(car: MovingObject, ego: EgoDrive) -> bool:
    """Return whether the ego car keeps its distance from the other's middle, and its sensors out of the outline."""
    together = (ego.times_s >= car.motion.x[0]) & (ego.times_s <= car.motion.x[-1])
    x, y, _, heading = car.motion(ego.times_s[together]).T
    off = ego.xy[together] - np.column_stack([x, y])
    along = np.cos(heading) * off[:, 0] + np.sin(heading) * off[:, 1]
    aside = np.cos(heading) * off[:, 1] - np.sin(heading) * off[:, 0]
    half_length, half_width = np.abs(car.mesh.vertices[:, :2]).max(axis=0) + _SENSORS_M
    inside = (np.abs(along) < half_length) & (np.abs(aside) < half_width)
    return bool(np.hypot(along, aside).min() > _CLEARANCE_M and not inside.any())
