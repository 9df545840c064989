"""The path of an IMU that is carried by hand: it turns about every axis within seconds."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from hybridlio.core import se3
from hybridlio.simulation.drive.path import SmoothPath

_KNOT_S = 0.05


def carried_path(seed: int, seconds: float) -> SmoothPath:
    """Return a walk of 1 m/s with swings of 20 to 40 degrees about each axis."""
    rng, times = np.random.default_rng(seed), np.arange(-0.5, seconds + 0.5, _KNOT_S)

    def waves(amplitude: float, periods: tuple[float, float]) -> np.ndarray:
        period, phase = rng.uniform(*periods, 3), rng.uniform(0, 2 * np.pi, 3)
        return amplitude * np.sin(2 * np.pi * times[:, None] / period + phase).sum(axis=1) / np.sqrt(3)

    angles = np.column_stack([waves(0.7, (3.0, 8.0)), waves(0.35, (1.5, 4.0)), waves(0.35, (1.5, 4.0))])
    position = np.column_stack([times + waves(0.3, (2.0, 6.0)), waves(0.5, (2.0, 6.0)), waves(0.1, (0.8, 2.0))])
    return SmoothPath.through(times, se3.make(Rotation.from_euler("ZYX", angles).as_matrix(), position))
