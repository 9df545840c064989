"""The motion of a body along the way of a scene, as one smooth path of its lidar's mount.

The path is sampled here and becomes a quintic spline, of which all truth and all inertial data are exact derivatives
(:mod:`hybridlio.simulation.drive.path`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation
from scipy.special import ndtr

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.motion_limits import GRAVITY_M_S2
from hybridlio.simulation.platforms.bodies import Body
from hybridlio.simulation.platforms.scenes.scene import Scene

STEP_S = 0.01  # of the samples: 7 in a period of the fastest tremor, 14 Hz
_ALONG_M = 0.05  # distance of points on the smoothed way
_REST_S, _START_S = 1.0, 0.8  # standing at the start, and the time constant of getting under way
_HEADING_S = 0.25  # smooths the heading, so that bodies turn before and after a corner
_SLOWEST = 0.25  # of the speed, in the sharpest corner
_STEEP = 1.5  # slows climbing: on stairs of 30° by 1.75, as people do
_CLEAR_M = 0.4  # below a ceiling


@dataclass(frozen=True, eq=False)
class _Way:
    """A smoothed way by its length: position, and the largest speed there."""

    position: CubicSpline
    speed: CubicSpline
    length_m: float

    @classmethod
    def of(cls, scene: Scene, body: Body, length_m: float) -> _Way:
        """Round the corners of a scene's way; a closed one is followed again and again."""
        way = scene.way
        steps = np.linalg.norm(np.diff(way, axis=0), axis=1)
        way = way[np.concatenate([[True], steps > 1e-9])]
        s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))])
        if scene.closed:
            turns = int(np.ceil((length_m + 2 * body.corner_m + 10.0) / s[-1])) + 1
            s = np.concatenate([[0.0], *(s[1:] + s[-1] * turn for turn in range(turns))])
            way = np.concatenate([way[:1], *([way[1:]] * turns)])
        even = np.arange(0.0, min(s[-1], length_m + 20.0), _ALONG_M)
        line = np.column_stack([np.interp(even, s, column) for column in way.T])
        line = gaussian_filter1d(line, body.corner_m / _ALONG_M, axis=0, mode="nearest")
        arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
        keep = np.concatenate([[True], np.diff(arc) > 1e-6])
        arc, line = arc[keep], line[keep]
        tangent = np.gradient(line, arc, axis=0)
        bend = np.linalg.norm(np.gradient(tangent, arc, axis=0), axis=1)
        most = np.minimum(np.sqrt(body.side_m_s2 / np.maximum(bend, 1e-9)), body.speed_m_s)
        most = np.maximum(most, _SLOWEST * body.speed_m_s)
        most = most / (1.0 + _STEEP * np.abs(tangent[:, 2]))
        brake = max(round(0.4 * body.speed_m_s / _ALONG_M), 1)  # slows down within about a second before a bend
        return cls(
            CubicSpline(arc, line), CubicSpline(arc, gaussian_filter1d(most, brake, mode="nearest")), float(arc[-1])
        )


def times_of(seconds: float, margin_s: float) -> Array:
    """Return the times of the samples of a path from ``-margin_s`` to ``seconds + margin_s``."""
    margin = round(margin_s / STEP_S)
    return np.asarray(np.arange(-margin, round(seconds / STEP_S) + margin + 1) * STEP_S, dtype=np.float64)


def body_poses(scene: Scene, body: Body, times_s: Array, start_moving: bool, rng: np.random.Generator) -> Array:
    """Return the poses ``T_world_mount`` ``(N, 4, 4)`` of a body at even times ``(N,)``.

    The mount is level and x looks ahead when the body stands.
    """
    body = replace(body, speed_m_s=min(body.speed_m_s, scene.speed_m_s))
    way = _Way.of(scene, body, body.speed_m_s * (times_s[-1] - times_s[0]) + 5.0)
    awake = np.ones(len(times_s)) if start_moving else ndtr((times_s - _REST_S - 2 * _START_S) / (_START_S / 2))
    s, effort = _travelled(way, body, times_s, awake, rng)
    place = gaussian_filter1d(way.position(s), 0.05 / STEP_S, axis=0, mode="nearest")
    ahead = way.position(np.minimum(s + 0.3, way.length_m)) - way.position(np.maximum(s - 0.3, 0.0))
    ahead = gaussian_filter1d(ahead, _HEADING_S / STEP_S, axis=0, mode="nearest")
    yaw = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    gait = 2 * np.pi * np.cumsum(body.step_hz * (0.6 + 0.4 * effort) * STEP_S) + rng.uniform(0, 2 * np.pi)
    place = place + np.array([0.0, 0.0, _height(scene, body)])
    place[:, 2] += body.bounce_m * effort * np.sin(gait) + awake * _climb(scene, body, times_s, rng)
    side = np.column_stack([-np.sin(yaw), np.cos(yaw), 0 * yaw])
    place += (body.sway_m * effort * np.sin(gait / 2))[:, None] * side
    tilt = awake[:, None] * _tilt(body, place, yaw, rng, times_s)
    angles = np.column_stack([yaw, 0 * yaw, 0 * yaw]) + tilt
    angles += np.outer(body.step_rad * effort, [0.5, 1.0, 1.0]) * np.sin(np.outer(gait, [0.5, 1.0, 0.5]))
    R = Rotation.from_euler("ZYX", angles) * _spins(body, times_s, start_moving, rng)
    return se3.make(R.as_matrix(), place)


def _height(scene: Scene, body: Body) -> float:
    return min(body.height_m, scene.headroom_m - _CLEAR_M)


def _travelled(way: _Way, body: Body, times_s: Array, awake: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return the length travelled on the way, and the speed as a share of the full one, both ``(N,)``."""
    mood = awake * (1.0 + _waves(rng, times_s, 0.1, (5.0, 20.0)))
    s, travelled = 1.0, np.empty(len(times_s))
    speeds, arcs = way.speed(np.arange(0.0, way.length_m, _ALONG_M)), np.arange(0.0, way.length_m, _ALONG_M)
    for k in range(len(times_s)):
        travelled[k] = s
        s += STEP_S * mood[k] * float(np.interp(s, arcs, speeds))
    travelled = gaussian_filter1d(travelled, 0.1 / STEP_S, mode="nearest")
    speed = np.gradient(travelled, STEP_S)
    return travelled, gaussian_filter1d(np.clip(speed / body.speed_m_s, 0.0, 1.2), 0.2 / STEP_S, mode="nearest")


def _waves(rng: np.random.Generator, times_s: Array, amplitude: float, periods_s: tuple[float, float]) -> Array:
    """Return a sum of four random waves of a total standard deviation of 0.7 times ``amplitude``."""
    period, phase = rng.uniform(*periods_s, 4), rng.uniform(0, 2 * np.pi, 4)
    return np.asarray(amplitude * np.sin(2 * np.pi * times_s[:, None] / period + phase).sum(axis=1) / 2)


def _climb(scene: Scene, body: Body, times_s: Array, rng: np.random.Generator) -> Array:
    """Return changes of height ``(N,)`` of a body that flies: from 0 up to what the headroom allows."""
    most = min(body.climb_m, max(scene.headroom_m - _CLEAR_M - _height(scene, body), 0.0))
    return most * (0.5 + 0.5 * np.sin(2 * _waves(rng, times_s, 0.5, (6.0, 15.0))))


def _tilt(body: Body, place: Array, yaw: Array, rng: np.random.Generator, times_s: Array) -> Array:
    """Return yaw, pitch and roll ``(N, 3)`` besides the heading: looking around, tremor, and the tilt of a flight."""
    look_yaw, look_pitch = body.look_rad
    out = np.column_stack([
        _waves(rng, times_s, look_yaw, (2.5, 9.0)),
        _waves(rng, times_s, look_pitch, (3.0, 8.0)),
        _waves(rng, times_s, 0.4 * look_pitch, (3.0, 8.0)),
    ])  # fmt: skip
    low_hz, high_hz = body.tremor_hz
    out += np.column_stack([_waves(rng, times_s, body.tremor_rad, (1 / high_hz, 1 / low_hz)) for _ in range(3)])
    if body.climb_m > 0:  # a drone leans into its acceleration
        accel = np.gradient(
            np.gradient(gaussian_filter1d(place, 0.15 / STEP_S, axis=0), STEP_S, axis=0), STEP_S, axis=0
        )
        c, s = np.cos(yaw), np.sin(yaw)
        out[:, 1] += np.arctan2(c * accel[:, 0] + s * accel[:, 1], GRAVITY_M_S2)
        out[:, 2] -= np.arctan2(-s * accel[:, 0] + c * accel[:, 1], GRAVITY_M_S2)
    return out


def _spins(body: Body, times_s: Array, start_moving: bool, rng: np.random.Generator) -> Rotation:
    """Return the fast turns ``(N,)`` of a drone: yaw by up to 270° within half a second, and nods and rolls of 40°."""
    vector = np.zeros((len(times_s), 3))
    if body.spins_per_s > 0:
        first = times_s[0] if start_moving else _REST_S + 4 * _START_S
        at = (
            first
            + 1.0
            + np.cumsum(rng.exponential(1 / body.spins_per_s, int(body.spins_per_s * len(times_s) * STEP_S)))
        )
        turned, nodded = np.zeros(len(times_s)), np.zeros((len(times_s), 2))
        for middle in at[at < times_s[-1] - 1.0]:
            yaw, width = rng.uniform(1.0, 4.7) * rng.choice([-1.0, 1.0]), rng.uniform(0.15, 0.3)
            turned += yaw * ndtr((times_s - middle) / width)
            tilt = rng.uniform(-0.7, 0.7, 2)
            nodded += tilt * np.exp(-0.5 * ((times_s - middle - rng.uniform(-0.3, 0.3)) / width) ** 2)[:, None]
        vector[:, :2] = nodded
        return Rotation.from_euler("Z", turned[:, None]) * Rotation.from_rotvec(vector)
    return Rotation.from_rotvec(vector)
