"""Coordinates of maps on Earth: from a local east-north-up frame to UTM."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hybridlio.core.errors import ConfigError, DataError
from hybridlio.core.geodesy import GeodeticPoint, geodetic_from_enu
from hybridlio.mapping.point_map import PointMap

if TYPE_CHECKING:
    from pyproj import CRS

_EPSG_GEODETIC, _EPSG_UTM_NORTH, _EPSG_UTM_SOUTH = 4979, 32600, 32700  # plus the zone's number
_ZONE_DEG = 6.0  # width of an UTM zone
_CHUNK = 1_000_000  # points converted at a time


def utm_crs(origin: GeodeticPoint) -> CRS:
    """Return the UTM zone (WGS 84) that an origin lies in. Heights are above the ellipsoid, in no zone's definition.

    Raises:
        ConfigError: pyproj is missing.
    """
    zone = int((origin.longitude_deg + 180.0) % 360.0 // _ZONE_DEG) + 1
    crs: CRS = _pyproj().CRS.from_epsg((_EPSG_UTM_NORTH if origin.latitude_deg >= 0 else _EPSG_UTM_SOUTH) + zone)
    return crs


def crs_of_file(path: Path) -> str | None:
    """Return the coordinate reference system that a ``.las`` or ``.laz`` file states, for :func:`crs_of`; else None."""
    if path.suffix.lower() not in (".las", ".laz"):
        return None
    import laspy

    _pyproj()  # laspy would leave the system out without a word
    with laspy.open(path) as file:
        crs = file.header.parse_crs()
    return None if crs is None else str(crs.to_string())


def crs_of(text: str) -> CRS:
    """Return the coordinate reference system of an authority's code, such as ``EPSG:32632``, or of its definition.

    Raises:
        ConfigError: pyproj is missing.
        DataError: there is no such system.
    """
    pyproj = _pyproj()
    try:
        crs: CRS = pyproj.CRS.from_user_input(text)
    except pyproj.exceptions.CRSError as error:
        raise DataError(f"unknown coordinate reference system {text:.60}: {error}") from None
    return crs


def projected(points: PointMap, origin: GeodeticPoint) -> PointMap:
    """Return a map whose points, in the east-north-up frame of ``origin``, are given in its UTM zone.

    Normals stay in the frame of the origin, which the zone's north differs from by up to 3°.

    Raises:
        ConfigError: pyproj is missing.
    """
    pyproj = _pyproj()
    to_utm = pyproj.Transformer.from_crs(_EPSG_GEODETIC, utm_crs(origin), always_xy=True)
    out = np.empty_like(points.points)
    for start in range(0, len(points), _CHUNK):
        rows = slice(start, start + _CHUNK)
        latitude, longitude, height = geodetic_from_enu(points.points[rows], origin).T
        east, north = to_utm.transform(longitude, latitude)
        out[rows] = np.column_stack([east, north, height])
    return replace(points, points=out)


def _pyproj() -> Any:
    try:
        import pyproj
    except ImportError:
        raise ConfigError("a georeferenced map needs pyproj: pip install 'hybridlio[map]'") from None
    return pyproj
