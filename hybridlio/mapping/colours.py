"""Colours of a map's points by one of their values."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from hybridlio.core.errors import ConfigError
from hybridlio.mapping.point_map import PointMap

_TAILS = (0.01, 0.99)  # quantiles at the ends of the colours; single stray points would use up the range
_MAX_SAMPLE = 1_000_000  # points that the quantiles are taken from


def colours_by(points: PointMap, name: str) -> NDArray[np.uint8] | None:
    """Return the colours ``(N, 3)`` of points by a name of :data:`COLOURS`; None for ``none``.

    Raises:
        ConfigError: unknown name, or the map has no intensity.
    """
    check_colour(name)
    choose = COLOURS[name]
    if choose is None or not len(points):
        return None if choose is None else np.empty((0, 3), np.uint8)
    values, scale = choose(points)
    if values is None:
        raise ConfigError("the scans have no intensity; choose another colour, such as height")
    from matplotlib import colormaps

    low, high = np.quantile(values[:: len(values) // _MAX_SAMPLE + 1], _TAILS)
    shares = (np.clip(values, low, high) - low) / max(high - low, 1e-9)
    table = (colormaps[scale](np.linspace(0, 1, 256))[:, :3] * 255).round().astype(np.uint8)
    return np.asarray(table[(shares * 255).astype(np.uint8)])


def check_colour(name: str) -> None:
    """Check the name of a colour.

    Raises:
        ConfigError: it is not one of :data:`COLOURS`.
    """
    if name not in COLOURS:
        raise ConfigError(f"unknown colour {name!r}; choose from {', '.join(COLOURS)}")


def _height(points: PointMap) -> tuple[NDArray[np.floating] | None, str]:
    return points.points[:, 2], "turbo"


def _intensity(points: PointMap) -> tuple[NDArray[np.floating] | None, str]:
    return points.intensity, "gray"


def _time(points: PointMap) -> tuple[NDArray[np.floating] | None, str]:
    return points.last_s, "viridis"


COLOURS: dict[str, Callable[[PointMap], tuple[NDArray[np.floating] | None, str]] | None] = {
    "height": _height,
    "intensity": _intensity,
    "time": _time,
    "none": None,
}
