"""Conversion between geodetic coordinates (WGS 84) and a local east-north-up frame, by pymap3d."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError, shown

EARTH_RADIUS_M = 6378137.0  # equatorial, WGS 84; KITTI's Mercator projection uses it
_ORIGIN_ITERATIONS = 5  # each gains a factor of distance over Earth radius: three digits at a few kilometres


class GeodeticPoint(NamedTuple):
    """A position on WGS 84: degrees, and metres above the ellipsoid."""

    latitude_deg: float
    longitude_deg: float
    height_m: float


def check_geodetic(latitude_deg: float, longitude_deg: float, height_m: float, name: str) -> GeodeticPoint:
    """Return the position as plain floats.

    Raises:
        DataError: not finite, a latitude beyond ±90° or a longitude beyond -180° to 360°; the message carries ``name``.
    """
    try:
        point = GeodeticPoint(float(latitude_deg), float(longitude_deg), float(height_m))
    except (TypeError, ValueError, OverflowError):
        given = ", ".join(shown(value) for value in (latitude_deg, longitude_deg, height_m))
        raise DataError(f"{name}: latitude, longitude and height must be numbers, got {given}") from None
    if not np.isfinite(point).all():
        raise DataError(f"{name}: latitude, longitude and height must be finite, got {tuple(point)}")
    if abs(point.latitude_deg) > 90:
        raise DataError(f"{name}: a latitude lies between -90 and 90 degrees, got {point.latitude_deg}")
    if not -180 <= point.longitude_deg <= 360:
        raise DataError(f"{name}: a longitude lies between -180 and 360 degrees, got {point.longitude_deg}")
    return point


def enu_from_geodetic(points: ArrayLike, origin: GeodeticPoint) -> Array:
    """Convert latitude, longitude (degrees) and height (m) ``(N, 3)`` to metres east, north and up of ``origin``."""
    import pymap3d

    latitude, longitude, height = np.asarray(points, dtype=np.float64).reshape(-1, 3).T
    return np.column_stack(pymap3d.geodetic2enu(latitude, longitude, height, *origin))


def geodetic_from_enu(positions_m: ArrayLike, origin: GeodeticPoint) -> Array:
    """Convert metres east, north and up of ``origin`` ``(N, 3)`` to latitude, longitude (degrees) and height (m)."""
    import pymap3d

    east, north, up = np.asarray(positions_m, dtype=np.float64).reshape(-1, 3).T
    return np.column_stack(pymap3d.enu2geodetic(east, north, up, *origin))


def origin_of(position_m: ArrayLike, point: GeodeticPoint) -> GeodeticPoint:
    """Return the origin of the east-north-up frame in which ``point`` has the position ``position_m`` ``(3,)``.

    Solved by fixed-point iteration, which starts with the origin at the point itself. Over a few kilometres the result
    is exact to a micrometre.
    """
    position = np.asarray(position_m, dtype=np.float64)
    origin = point
    for _ in range(_ORIGIN_ITERATIONS):
        off = enu_from_geodetic([point], origin)[0] - position
        origin = GeodeticPoint(*geodetic_from_enu([off], origin)[0].tolist())
    return origin
