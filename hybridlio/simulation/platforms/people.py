"""People who walk around a sensor: some go along with it, others meet it.

They are rigid: arms and legs do not swing.
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline

from hybridlio.core.arrays import Array
from hybridlio.simulation.drive.path import SmoothPath
from hybridlio.simulation.random_streams import RandomStream
from hybridlio.simulation.world.moving import MovingObject
from hybridlio.simulation.world.rays import RayScene
from hybridlio.simulation.world.shapes import Mesh, boxes, cylinder, merge

_ALONG_SHARE = 0.5  # of the people go along with the sensor, some seconds ahead or behind
_ALONG_S = (1.2, 4.0)  # 1.7 to 5.6 m at walking pace
_ASIDE_M = (0.6, 1.2)  # of those who meet it: they pass without touching
_PACE = (0.7, 1.2)  # relative to the sensor's
_STEP_S = 0.1
_SMOOTH_STEPS = 5  # over half a second, so that people do not copy the sensor's shakes
_HEIGHTS_M = (1.5, 1.95)
_CLOTHES = (0.2, 0.7)  # reflectance of cloth and skin at 905 nm: dark synthetics to light cotton
_RADIUS_M = 1.1


def people_around(rays: RayScene, path: SmoothPath, seconds: float, count: int, seed: int) -> list[MovingObject]:
    """Draw the people of a recording.

    Args:
        rays: the scene, on whose floor they walk.
        path: of the sensor.
        seconds: duration of the recording.
        count: number of people.
        seed: of the recording.
    """
    return [_person(rays, path, seconds, (seed, int(RandomStream.PEOPLE), number)) for number in range(count)]


def _person(rays: RayScene, path: SmoothPath, seconds: float, seed: tuple[int, int, int]) -> MovingObject:
    rng = np.random.default_rng(seed)
    times_s = np.arange(path.start_s, path.end_s, _STEP_S)
    if rng.random() < _ALONG_SHARE:
        there_s, aside_m = times_s + rng.choice([-1, 1]) * rng.uniform(*_ALONG_S), rng.uniform(-0.7, 0.7)
    else:
        meeting_s = rng.uniform(0.0, seconds)
        there_s = meeting_s - rng.uniform(*_PACE) * (times_s - meeting_s)
        aside_m = rng.choice([-1, 1]) * rng.uniform(*_ASIDE_M)
    known = (there_s > path.start_s) & (there_s < path.end_s)
    if known.sum() < 2 * _SMOOTH_STEPS:  # too short to matter; stand at the start
        there_s, known = np.full(len(times_s), path.start_s + _ALONG_S[0]), np.ones(len(times_s), bool)
    xyz, heading = _walk(path, there_s[known])
    left = np.column_stack([-np.sin(heading), np.cos(heading)])
    # the floor of the sensor's way, which is clear: beside it there may be a table
    motion = np.column_stack([xyz[:, :2] + aside_m * left, _floor(rays, xyz), heading])
    return MovingObject(CubicSpline(times_s[known], motion), seed, person, 0.9, _RADIUS_M)


def _walk(path: SmoothPath, there_s: Array) -> tuple[Array, Array]:
    """Return positions ``(N, 3)`` on the sensor's path, without its shakes, and headings ``(N,)``."""
    xyz = path.poses(there_s)[:, :3, 3]
    xyz = np.column_stack([_smooth(column) for column in xyz.T])
    way = np.gradient(xyz[:, :2], axis=0)
    return xyz, np.unwrap(np.arctan2(way[:, 1], way[:, 0]))


def _smooth(values: Array) -> Array:
    padded = np.pad(values, _SMOOTH_STEPS, mode="edge")
    window = np.ones(2 * _SMOOTH_STEPS + 1) / (2 * _SMOOTH_STEPS + 1)
    return np.convolve(padded, window, mode="valid")


def _floor(rays: RayScene, xyz: Array) -> Array:
    """Return the height of the surface below each position; that 1.5 m below it where there is none."""
    below = rays.cast(xyz, np.broadcast_to([0.0, 0.0, -1.0], xyz.shape)).range_m
    return np.asarray(xyz[:, 2] - np.where(np.isfinite(below), below, 1.5))


def person(rng: np.random.Generator) -> Mesh:
    """Return a standing person: legs, trunk, arms and head."""
    height, shade, dark = rng.uniform(*_HEIGHTS_M), rng.uniform(*_CLOTHES), rng.uniform(*_CLOTHES)
    hip, shoulder = 0.47 * height, 0.82 * height
    leg, arm = cylinder(0.09, 0.10, 0.0, hip, dark), cylinder(0.05, 0.06, hip, shoulder, shade)
    parts = [leg.moved((stride, side, 0.0)) for side, stride in ((-0.1, 0.12), (0.1, -0.12))]
    parts += [arm.moved((0.0, side, 0.0)) for side in (-0.26, 0.26)]
    parts.append(boxes((-0.12, -0.2, hip), (0.12, 0.2, shoulder), shade))
    parts.append(cylinder(0.09, 0.08, 0.86 * height, height, 0.5))
    return merge(parts)
