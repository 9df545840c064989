"""Colours of what viewers show."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridlio.viewing.scene import BRIDGED

Colour = tuple[int, int, int]

SCAN, FINAL, INITIAL, OTHER, LOOP = (255, 255, 255), (0, 200, 120), (255, 170, 0), (150, 150, 150), (220, 80, 220)
FREE_SHIFT, FREE_TURN = (255, 60, 60), (255, 140, 200)
FIX, WRONG_FIX = (80, 160, 255), (255, 60, 60)
XYZ: tuple[Colour, Colour, Colour] = ((230, 70, 70), (70, 190, 70), (80, 120, 240))
DOUBTFUL: dict[str, Colour] = {  # scans that do not count fully, by their support
    BRIDGED: (255, 60, 60),
    "rejected": (255, 60, 60),
    "relocated": (220, 80, 220),
    "undecided": (255, 140, 0),
    "down-weighted": (255, 210, 0),
    "IMU left out": (80, 160, 255),
}
SIGMA_RANGE_M = (0.01, 10.0)  # of the path's colours: a lidar's range noise, and lost
_HEIGHT_RANGE_M = (-3.0, 12.0)  # about the lidar: the road below a van, and the roofs of houses


def by_sigma(sigmas_m: ArrayLike) -> NDArray[np.uint8]:
    """Return colours ``(N, 3)`` of standard deviations ``(N,)``: their logarithm within :data:`SIGMA_RANGE_M`."""
    low, high = np.log10(SIGMA_RANGE_M)
    logs = np.log10(np.maximum(np.asarray(sigmas_m, dtype=np.float64), SIGMA_RANGE_M[0]))
    return _looked_up((logs - low) / (high - low), "turbo")


def by_height(heights_m: ArrayLike, lidar_m: float) -> NDArray[np.uint8]:
    """Return colours ``(N, 3)`` of heights ``(N,)`` about that of the lidar."""
    low, high = _HEIGHT_RANGE_M
    return _looked_up((np.asarray(heights_m) - lidar_m - low) / (high - low), "viridis")


def _looked_up(shares: ArrayLike, scale: str) -> NDArray[np.uint8]:
    return np.asarray(_table(scale)[(np.clip(shares, 0.0, 1.0) * 255).astype(np.uint8)])


@cache
def _table(scale: str) -> NDArray[np.uint8]:
    """Return the colours ``(256, 3)`` of a scale of Matplotlib."""
    from matplotlib import colormaps

    return np.asarray((colormaps[scale](np.arange(256))[:, :3] * 255).round().astype(np.uint8))
