"""Cars that drive: oncoming ones, and ones ahead of and behind the recording car."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.simulation.world import street
from hybridlio.simulation.world.ground import Ground
from hybridlio.simulation.world.roads import LANE_OFFSET_M, Road
from hybridlio.simulation.world.shapes import Mesh
from hybridlio.simulation.world.world import RayScene

_CLEARANCE_M = 3.0
_REACH_M = 90.0
CAR_RADIUS_M = 5.5
_SENSORS_M = 0.5  # around the recording car's IMU


@dataclass(eq=False)
class MovingCar:
    """A car with a motion: ``(x, y, z, heading)`` over the seconds that it is there for."""

    motion: CubicSpline
    shape_seed: tuple[int, int]
    _scene: RayScene | None = None

    def present(self, time_s: float) -> bool:
        """Whether the car is on the road at ``time_s``."""
        return bool(self.motion.x[0] <= time_s <= self.motion.x[-1])

    def poses(self, times_s: Array) -> Array:
        """``T_world_car`` ``(N, 4, 4)``; held at the ends of its time."""
        x, y, z, heading = self.motion(np.clip(times_s, self.motion.x[0], self.motion.x[-1])).T
        c, s, zero, one = np.cos(heading), np.sin(heading), np.zeros_like(x), np.ones_like(x)
        R = np.stack([c, -s, zero, s, c, zero, zero, zero, one], axis=-1).reshape(-1, 3, 3)
        return se3.make(R, np.stack([x, y, z], axis=-1))

    @property
    def mesh(self) -> Mesh:
        """Its shape, in its own frame."""
        return street.car(np.random.default_rng(self.shape_seed))

    @property
    def scene(self) -> RayScene:
        """Its shape, ready for rays."""
        if self._scene is None:
            self._scene = RayScene.of(self.mesh, np.zeros(3))
        return self._scene


def traffic(
    centreline: Road, lane: Road, ego_s: Array, times_s: Array, ego_xy: Array, ground: Ground, per_km: float, seed: int
) -> list[MovingCar]:
    """Moving cars of a drive whose own car is at ``ego_s`` ``(N,)`` of its lane, at ``ego_xy``, at ``times_s``.

    Seven in ten come the other way, the others keep some seconds ahead or behind. Cars that would come too near the
    recording car (where the road crosses itself) stay at home.
    """
    rng = np.random.default_rng([seed, 5])
    cars = []
    driven = float(ego_s[-1] - ego_s[0])
    mean_speed = max(driven / float(times_s[-1] - times_s[0]), 4.0)
    for number in range(rng.poisson(per_km * (2 * driven + 200.0) / 1000.0)):
        if rng.random() < 0.7:
            speed = mean_speed * rng.uniform(0.7, 1.3)
            meeting = float(ego_s[0]) + rng.uniform(-50.0, 2 * driven + 150.0)
            motion = _motion(centreline, meeting - speed * times_s, LANE_OFFSET_M, times_s, ground)
        else:
            shifted = times_s + rng.choice([-1, 1]) * rng.uniform(2.0, 6.0)
            s = np.where((shifted > times_s[0]) & (shifted < times_s[-1]), np.interp(shifted, times_s, ego_s), -1.0)
            motion = _motion(lane, s, 0.0, times_s, ground)
        car = None if motion is None else MovingCar(motion, (seed, 1000 + number))
        if car is not None and _keeps_clear(car, times_s, ego_xy):
            cars.append(car)
    return cars


def _motion(road: Road, s: Array, left_m: float, times_s: Array, ground: Ground) -> CubicSpline | None:
    """Position, height and heading over the time that ``s`` is on the road; None where that is short."""
    on_road = (s > 1.0) & (s < road.length_m - 1.0)
    if on_road.sum() < 10:
        return None
    s, times_s = s[on_road], times_s[on_road]
    xy = road.beside(s, left_m)
    heading = np.unwrap(road.heading(s) + (np.pi if left_m > 0 else 0.0))
    return CubicSpline(times_s, np.column_stack([xy, ground.height(xy), heading]))


def _keeps_clear(car: MovingCar, times_s: Array, ego_xy: Array) -> bool:
    """Whether the recording car keeps away from the moving one's middle, and its sensors out of its outline."""
    together = (times_s >= car.motion.x[0]) & (times_s <= car.motion.x[-1])
    x, y, _, heading = car.motion(times_s[together]).T
    off = ego_xy[together] - np.column_stack([x, y])
    along = np.cos(heading) * off[:, 0] + np.sin(heading) * off[:, 1]
    aside = np.cos(heading) * off[:, 1] - np.sin(heading) * off[:, 0]
    half_length, half_width = np.abs(car.mesh.vertices[:, :2]).max(axis=0) + _SENSORS_M
    inside = (np.abs(along) < half_length) & (np.abs(aside) < half_width)
    return bool(np.hypot(along, aside).min() > _CLEARANCE_M and not inside.any())


def in_reach(cars: Sequence[MovingCar], position: Array, time_s: float) -> list[MovingCar]:
    """The cars that are near enough to be seen from ``position`` ``(3,)``."""
    near = []
    for car in cars:
        if car.present(time_s):
            at = car.poses(np.array([time_s]))[0, :3, 3]
            if np.linalg.norm(at - position) < _REACH_M:
                near.append(car)
    return near
