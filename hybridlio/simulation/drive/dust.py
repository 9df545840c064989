"""Clouds of dust along the ego car's way, as other vehicles or the wind raise them."""

from __future__ import annotations

import numpy as np

from hybridlio.simulation.drive.traffic import EgoDrive
from hybridlio.simulation.random_streams import RandomStream
from hybridlio.simulation.sensors.air import DustClouds
from hybridlio.simulation.world.ground import Ground

_ASIDE_M = 5.0  # standard deviation of the distance from the lane, when the ego car passes
_RADII_M = (1.5, 4.0)  # a cloud behind a car
# From a haze to dust that hides what is behind it: half of the light is lost on a way of 14 and of 1.4 m.
_EXTINCTIONS_1_M = (0.05, 0.5)
_WIND_M_S = (0.5, 4.0)  # light air to a gentle breeze


def dust_clouds(ego: EgoDrive, ground: Ground, per_km: float, seed: int) -> DustClouds:
    """Draw the clouds of a drive; each drifts past its place beside the lane when the ego car does.

    Args:
        ego: the ego car's drive.
        ground: above which the clouds are.
        per_km: clouds per kilometre driven.
        seed: of the drive.
    """
    rng = np.random.default_rng([seed, RandomStream.DUST])
    first, last = float(ego.s[0]), float(ego.s[-1])
    count = rng.poisson(per_km * (last - first) / 1000.0)
    s = rng.uniform(first, last, count)
    xy = ego.lane.beside(s, 0.0) + rng.normal(0.0, _ASIDE_M, (count, 2))
    radii_m = rng.uniform(*_RADII_M, count)
    centres = np.column_stack([xy, ground.height(xy) + radii_m * rng.uniform(0.2, 0.8, count)])
    speed, towards = rng.uniform(*_WIND_M_S), rng.uniform(-np.pi, np.pi)
    wind_m_s = speed * np.array([np.cos(towards), np.sin(towards), 0.0])
    times_s = np.interp(s, ego.s, ego.times_s)
    least, most = _EXTINCTIONS_1_M
    extinctions_1_m = least * (most / least) ** rng.random(count)
    return DustClouds(centres, times_s, wind_m_s, radii_m, extinctions_1_m)
