"""A road tunnel, and a drift of a mine."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d

from hybridlio.simulation.platforms.scenes.scene import Scene
from hybridlio.simulation.platforms.scenes.tube import beside, tube
from hybridlio.simulation.world.ground import waves
from hybridlio.simulation.world.shapes import merge

# A road tunnel of two lanes (8 m between kerbs) under a vault of 6 m, with walkways of 0.9 m: usual European profile.
_TUNNEL_RIGHT = [(1.0, 6.1), (2.8, 5.7), (4.2, 4.7), (4.9, 3.2), (4.9, 0.2), (4.0, 0.2), (4.0, 0.0)]
_TUNNEL = np.array([*_TUNNEL_RIGHT[::-1], *((-y, z) for y, z in _TUNNEL_RIGHT)])
_LANE_M = 2.0  # from the middle
_CONCRETE, _ROCK = 0.35, 0.25  # reflectances: grey concrete, dark rock
_STEP_M = 1.0  # of the tunnel's sections
_DRIFT_M = (4.6, 3.6)  # width and height of the drift: what a loader needs


def tunnel(rng: np.random.Generator, length_m: float) -> Scene:
    """Build a road tunnel as long as the way: wide bends, lamps, fans, signs and cabinets, and nothing else."""
    arc = np.arange(0.0, length_m + 160.0, _STEP_M)
    heading = 0.35 * waves(rng, 5, (200.0, 600.0), 0.02)(np.column_stack([arc, 0 * arc]))
    flat = np.cumsum(np.column_stack([np.cos(heading), np.sin(heading)]) * _STEP_M, axis=0)
    line = np.column_stack([flat, waves(rng, 4, (200.0, 500.0), 0.01)(np.column_stack([arc, 0 * arc]))])
    parts = [tube(line, _TUNNEL, _CONCRETE, 0.3, waves(rng, 24, (1.5, 8.0), 0.03))]
    furniture = [
        (10.0, (-0.6, -0.15, 5.7), (0.6, 0.15, 5.8), 0.2),  # lamps
        (75.0, (-1.5, -1.9, 4.6), (1.5, -1.1, 5.4), 5.0),  # fans
        (25.0, (-0.2, 4.75, 0.9), (0.2, 4.95, 1.2), 1.0),  # signs of ways out
        (50.0, (-0.5, -4.95, 0.2), (0.5, -4.6, 2.0), 8.0),  # cabinets with telephones
        (60.0, (-1.0, 4.7, 0.2), (1.0, 4.95, 2.4), 10.0),  # doors
    ]
    parts += [beside(line, every, np.array(low), np.array(high), jitter, rng) for every, low, high, jitter in furniture]
    normal = np.column_stack([np.sin(heading), -np.cos(heading), 0 * heading])
    return Scene(merge(parts), (line + _LANE_M * normal)[60:-20], False, 4.5)


def mine(rng: np.random.Generator, _length_m: float) -> Scene:
    """Build a closed drift of a mine: rough rock, timber sets, pipes and boulders; the way follows it around."""
    angle = np.linspace(0.0, 2 * np.pi, 400)
    size = rng.uniform([28.0, 18.0], [40.0, 28.0])
    bent = 1.0 + 0.25 * np.sin(3 * angle + rng.uniform(0, 6)) * rng.uniform(0.4, 1.0)
    bent += 0.1 * np.sin(5 * angle + rng.uniform(0, 6))
    line = np.column_stack([np.cos(angle) * bent * size[0], np.sin(angle) * bent * size[1], 1.5 * np.sin(2 * angle)])
    width, height = _DRIFT_M
    turn = np.linspace(-np.pi / 2, 1.5 * np.pi, 28, endpoint=False)
    profile = np.column_stack([np.cos(turn) * width / 2, height / 2 + np.sin(turn) * height / 2])
    profile[:, 1] = np.maximum(profile[:, 1], 0.12 * np.abs(np.cos(turn)))
    rough = tube(line, profile, _ROCK, 1.0, waves(rng, 60, (0.8, 6.0), 0.25))
    parts = [
        rough,
        beside(line, 7.0, np.array([-0.12, -2.05, -0.1]), np.array([0.12, -1.85, 2.9]), 1.0, rng),
        beside(line, 7.0, np.array([-0.12, 1.85, -0.1]), np.array([0.12, 2.05, 2.9]), 1.0, rng),
        beside(line, 7.0, np.array([-0.1, -2.0, 2.75]), np.array([0.1, 2.0, 2.95]), 0.5, rng),
        beside(line, 4.0, np.array([-2.0, 1.7, 2.2]), np.array([2.0, 1.85, 2.35]), 0.0, rng),
        beside(line, 5.0, np.array([-0.4, -2.0, -0.2]), np.array([0.3, -1.4, 0.5]), 2.4, rng),
    ]
    way = gaussian_filter1d(line, 3.0, axis=0, mode="wrap")
    return Scene(merge(parts), np.concatenate([way, way[:1]]), True, 2.6)
