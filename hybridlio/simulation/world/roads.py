"""Roads: the route as a smooth centreline, and the speed of a driver along it.

Lengths of straights, angles and chances are plausible for a European town and were chosen by eye on rendered scans.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from hybridlio.core.arrays import Array
from hybridlio.simulation.choices import Driving, Scene

STEP_M = 0.5  # between points of a sampled road: a twentieth of the smallest bend's radius
LANE_OFFSET_M = 1.75  # from the centreline to the middle of a lane 3.5 m wide
# Smoothing of corners. A right angle gets a smallest radius of 0.89 times this, about 10 m: a turn at a junction.
CORNER_SIGMA_M = 11.0
_STOP_CHANCE = 0.25  # at a bend: most junctions are passed without a stop
_STOP_BEFORE_M = 6.0  # the stop line is this far before the slowest point of the bend
_FREE_START_M = 40.0  # no stop in the first metres, so that short drives move
_MIN_CLEARANCE_M = 45.0  # between pieces of the route, so that houses fit between them
_ROAD_RESERVE_M = 60.0  # added to the length, because smoothing shortens corners
_MIN_CURVATURE_1_M = 1e-4  # keeps the speed limit of a straight finite
_ARRIVED_M_S = 0.15  # below it, a car that brakes for a stop has stopped


@dataclass(frozen=True)
class Manner:
    """Largest accelerations of a driver.

    Calm values are those of ordinary traffic, hard ones near the grip of tyres on dry asphalt (7 to 9 m/s²).
    """

    lateral_m_s2: float
    brake_m_s2: float
    accelerate_m_s2: float


MANNERS: dict[Driving, Manner] = {"calm": Manner(2.0, 1.8, 1.4), "hard": Manner(6.0, 7.0, 3.5)}


@dataclass(frozen=True, eq=False)
class Road:
    """A smooth curve in the plane, parametrised by arc length in metres.

    Attributes:
        curve: position ``(…, 2)`` in metres at an arc length.
        length_m: arc length of the end.
    """

    curve: CubicSpline
    length_m: float

    @classmethod
    def through(cls, points: Array) -> Road:
        """Return the curve through densely spaced points ``(N, 2)``."""
        s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
        even = np.linspace(0.0, s[-1], max(int(s[-1] / STEP_M), 8) + 1)
        return cls(CubicSpline(even, CubicSpline(s, points)(even)), float(s[-1]))

    def at(self, s: Array) -> Array:
        """Return positions ``(…, 2)`` at arc lengths ``s``."""
        return np.asarray(self.curve(s))

    def heading(self, s: Array) -> Array:
        """Return headings in radians at arc lengths ``s``, continuous if ``s`` ascends."""
        tangent = self.curve(s, 1)
        return np.asarray(np.unwrap(np.arctan2(tangent[..., 1], tangent[..., 0])))

    def curvature(self, s: Array) -> Array:
        """Return signed curvatures in 1/m at arc lengths ``s``, positive to the left."""
        first, second = self.curve(s, 1), self.curve(s, 2)
        cross = first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]
        return np.asarray(cross / np.linalg.norm(first, axis=-1) ** 3)

    def beside(self, s: Array, left_m: float | Array) -> Array:
        """Return positions ``(N, 2)``, ``left_m`` metres to the left of the curve at arc lengths ``s`` ``(N,)``."""
        tangent = self.curve(s, 1)
        tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
        normal = np.stack([-tangent[..., 1], tangent[..., 0]], axis=-1)
        return np.asarray(self.curve(s) + normal * np.asarray(left_m)[..., None])


def generate_centreline(
    rng: np.random.Generator, length_m: float, scene: Scene, round_trip_m: float | None = None
) -> Road:
    """Generate a road of at least ``length_m``; with ``round_trip_m``, it returns to its start after that length."""
    corners = _loop_corners(rng, length_m, round_trip_m) if round_trip_m else _open_corners(rng, length_m, scene)
    corners = corners + rng.normal(0.0, 0.05, corners.shape)
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    even = np.arange(0.0, s[-1], STEP_M)
    dense = np.column_stack([np.interp(even, s, corners[:, i]) for i in range(2)])
    smooth = gaussian_filter1d(dense, CORNER_SIGMA_M / STEP_M, axis=0, mode="nearest")
    return Road.through(smooth[40:-40])


def _open_corners(rng: np.random.Generator, length_m: float, scene: Scene) -> Array:
    """Draw the corners ``(N, 2)`` of a route that stays clear of itself, if possible within 30 trials per piece."""
    heading = rng.uniform(-np.pi, np.pi)
    points, walked, last_turn = [np.zeros(2)], 0.0, 0.0
    while walked < length_m + _ROAD_RESERVE_M:
        for _ in range(30):
            leg, turn = _leg(rng, scene)
            if points[1:] and abs(last_turn) > 0.5 and turn * last_turn > 0 and rng.random() < 0.7:
                turn = -turn
            end = points[-1] + leg * np.array([np.cos(heading + turn), np.sin(heading + turn)])
            if _clear_of(points, end):
                break
        heading, last_turn, walked = heading + turn, turn, walked + leg
        points.append(end)
    return np.array(points)


def _leg(rng: np.random.Generator, scene: Scene) -> tuple[float, float]:
    """Draw the length in metres of the next straight piece, and the turn in radians before it."""
    sign = rng.choice([-1.0, 1.0])
    if scene != "town":
        return rng.uniform(120.0, 300.0), sign * np.radians(rng.uniform(0.0, 6.0 if scene == "corridor" else 20.0))
    if rng.random() < 0.35:
        return rng.uniform(70.0, 220.0), sign * np.radians(rng.uniform(80.0, 100.0))
    return rng.uniform(50.0, 180.0), sign * np.radians(rng.uniform(3.0, 40.0))


def _clear_of(points: list[Array], end: Array) -> bool:
    """Return whether the piece from the last point to ``end`` keeps its distance from the route so far."""
    if len(points) < 3:
        return True
    piece = points[-1] + np.linspace(0.3, 1.0, 12)[:, None] * (end - points[-1])
    old = np.array(points[:-1])
    between = old[:-1, None] + np.linspace(0, 1, 20)[:, None] * (old[1:] - old[:-1])[:, None]
    gap = np.linalg.norm(piece[:, None] - between.reshape(-1, 2), axis=-1)
    return bool(gap.min() > _MIN_CLEARANCE_M)


def _loop_corners(rng: np.random.Generator, length_m: float, round_trip_m: float) -> Array:
    """Draw the corners of a route around two blocks: once around both, then at random at junctions, without U-turns."""
    width, depth = round_trip_m * rng.uniform(0.14, 0.18), round_trip_m * rng.uniform(0.16, 0.2)
    grid = {(i, j): np.array([i * width, j * depth]) + rng.normal(0.0, 4.0, 2) for i in range(3) for j in range(2)}
    walk = [(0, 0), (1, 0), (2, 0), (2, 1), (1, 1), (0, 1), (0, 0), (1, 0)]
    angle = rng.uniform(-np.pi, np.pi)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])

    def walked() -> float:
        return float(np.linalg.norm(np.diff([grid[n] for n in walk], axis=0), axis=1).sum())

    while walked() < length_m + _ROAD_RESERVE_M:
        (i, j), back = walk[-1], walk[-2]
        ways = [n for n in ((i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1)) if n in grid and n != back]
        walk.append(ways[rng.integers(len(ways))])
    return np.asarray(np.array([grid[n] for n in walk]) @ turn.T)


def speed_limit(road: Road, cruise_m_s: float, rng: np.random.Generator, manner: Manner = MANNERS["calm"]) -> Array:
    """Return the speed at each ``STEP_M`` of the road, limited by bends, slowly varying, braking in time."""
    s = np.arange(0.0, road.length_m, STEP_M)
    variation = 1.0 + 0.12 * np.sin(2 * np.pi * s / rng.uniform(150, 400) + rng.uniform(0, 6)) - 0.08
    bend = np.sqrt(manner.lateral_m_s2 / np.maximum(np.abs(road.curvature(s)), _MIN_CURVATURE_1_M))
    limit = np.minimum(cruise_m_s * variation, bend)
    for i in range(len(limit) - 2, -1, -1):
        limit[i] = min(limit[i], np.sqrt(limit[i + 1] ** 2 + 2 * manner.brake_m_s2 * STEP_M))
    return np.asarray(limit)


def drive(
    road: Road,
    start_m: float,
    cruise_m_s: float,
    times_s: Array,
    start_moving: bool,
    rng: np.random.Generator,
    manner: Manner = MANNERS["calm"],
) -> Array:
    """Drive along a road, braking for bends and stopping at some.

    Args:
        road: the lane.
        start_m: arc length of the start.
        cruise_m_s: cruising speed.
        times_s: ``(N,)``, evenly spaced.
        start_moving: whether the car moves at the first time; else it stands until two seconds after time zero.
        rng: decides where the car stops, and for how long.
        manner: the driver's largest accelerations.

    Returns:
        Metres ``(N,)`` driven since ``start_m``.
    """
    limit = speed_limit(road, cruise_m_s, rng, manner)
    slow = (limit[1:-1] < 0.55 * cruise_m_s) & (limit[1:-1] <= limit[:-2]) & (limit[1:-1] < limit[2:])
    stops = [
        i * STEP_M - _STOP_BEFORE_M
        for i in np.flatnonzero(slow)
        if rng.random() < _STOP_CHANCE and i * STEP_M > start_m + _FREE_START_M
    ]
    dt = float(times_s[1] - times_s[0])
    speed = float(limit[int(start_m / STEP_M)]) if start_moving else 0.0
    s, wait = start_m, (0.0 if start_moving else 2.0 - float(times_s[0]))
    speeds = np.empty(len(times_s))
    for k in range(len(times_s)):
        speeds[k] = speed
        if wait > 0.0:
            speed, wait = 0.0, wait - dt
            continue
        goal = limit[min(int(s / STEP_M), len(limit) - 1)]
        if stops:
            goal = min(goal, np.sqrt(2 * manner.brake_m_s2 * max(stops[0] - s, 0.0)))
            if goal < _ARRIVED_M_S:
                stops.pop(0)
                wait = rng.uniform(1.5, 4.0)
        speed += np.clip(goal - speed, -2 * manner.brake_m_s2 * dt, manner.accelerate_m_s2 * dt)
        s += speed * dt
    speeds = np.maximum(gaussian_filter1d(speeds, 0.25 / dt, mode="nearest"), 0.0)
    s_of_t = np.concatenate([[0.0], np.cumsum((speeds[1:] + speeds[:-1]) / 2 * dt)])
    return np.asarray(np.minimum(s_of_t, road.length_m - start_m))
