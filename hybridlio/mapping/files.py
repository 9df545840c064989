"""Write maps as ``.ply``, ``.pcd``, ``.las``, ``.laz`` or ``.npz``."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from hybridlio.core.errors import ConfigError
from hybridlio.core.files import atomic_path, user_path
from hybridlio.mapping.colours import colours_by
from hybridlio.mapping.point_map import PointMap

if TYPE_CHECKING:
    from pyproj import CRS

Colours: TypeAlias = NDArray[np.uint8]
_LAS_SCALE_M = 0.001  # of LAS coordinates, which are integers: well below a voxel, and 2,000 km fit 32 bits
_PLY_TYPES = {"f8": "double", "f4": "float", "u2": "ushort", "u1": "uchar"}


def write_map(path: str | os.PathLike[str], points: PointMap, colour: str = "height", crs: CRS | None = None) -> None:
    """Write a map; the suffix chooses the format.

    ``.ply`` and ``.pcd`` (binary) have x y z and, where known, normals, intensity, times and colours. ``.las`` and
    ``.laz`` are version 1.4, point format 7, with times as GPS time and normals as extra dimensions. ``.npz`` has the
    arrays of :class:`~hybridlio.mapping.point_map.PointMap`. Coordinates of ``.ply`` are float64, those of ``.pcd``
    float32, which is 4 mm at 50 km.

    Args:
        path: the file, which appears whole.
        points: the map.
        colour: a name of :data:`hybridlio.mapping.colours.COLOURS`.
        crs: coordinate reference system of the points; only ``.las`` and ``.laz`` hold it.

    Raises:
        ConfigError: unknown suffix or colour, a colour by a value that the map lacks, or a missing library.
        DataError: the file cannot be written.
    """
    path = user_path(path)
    write = _writer(path)
    colours = colours_by(points, colour)
    with atomic_path(path) as part:
        write(part, points, colours, crs)


def check_map_path(path: Path) -> None:
    """Check that maps can be written to files of this suffix, before the work begins.

    Raises:
        ConfigError: unknown suffix, or a library is missing.
    """
    if _writer(path) is _write_las:
        _laspy()


def holds_crs(suffix: str) -> bool:
    """Return whether files of this suffix hold a coordinate reference system."""
    return _WRITERS.get(suffix.lower()) is _write_las


def _writer(path: Path) -> Callable[[Path, PointMap, Colours | None, Any], None]:
    try:
        return _WRITERS[path.suffix.lower()]
    except KeyError:
        raise ConfigError(f"{path}: unknown format; use one of {', '.join(_WRITERS)}") from None


def _columns(points: PointMap, colours: Colours | None, coordinates: str) -> dict[str, NDArray[Any]]:
    """Return the columns of the map by their names in ``.ply`` files."""
    columns: dict[str, NDArray[Any]] = dict(zip("xyz", points.points.T.astype(coordinates), strict=True))
    if points.normals is not None:
        columns |= dict(zip(("nx", "ny", "nz"), points.normals.T, strict=True))
    if points.intensity is not None:
        columns["intensity"] = points.intensity
    columns |= {"first_s": points.first_s, "last_s": points.last_s, "scans": points.scans}
    if colours is not None:
        columns |= dict(zip(("red", "green", "blue"), colours.T, strict=True))
    return columns


def _rows(columns: dict[str, NDArray[Any]]) -> NDArray[Any]:
    rows = np.empty(len(columns["x"]), [(name, column.dtype.str) for name, column in columns.items()])
    for name, column in columns.items():
        rows[name] = column
    return rows


def _kinds(rows: NDArray[Any]) -> list[tuple[str, str]]:
    """Return name and type, such as ``f4``, of each column."""
    return [(name, rows.dtype[name].str[1:]) for name in rows.dtype.names or ()]


def _write_ply(path: Path, points: PointMap, colours: Colours | None, _crs: object) -> None:
    rows = _rows(_columns(points, colours, "<f8"))
    properties = "".join(f"property {_PLY_TYPES[kind]} {name}\n" for name, kind in _kinds(rows))
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{properties}end_header\n"
    with path.open("wb") as file:
        file.write(header.encode())
        file.write(rows.tobytes())


def _write_pcd(path: Path, points: PointMap, colours: Colours | None, _crs: object) -> None:
    columns = _columns(points, None, "<f4")
    names = {"nx": "normal_x", "ny": "normal_y", "nz": "normal_z"}
    columns = {names.get(name, name): column for name, column in columns.items()}
    if colours is not None:  # PCL's convention: one column, 0x00RRGGBB
        red, green, blue = colours.T.astype(np.uint32)
        columns["rgb"] = red << 16 | green << 8 | blue
    rows = _rows(columns)
    kinds = [kind for _, kind in _kinds(rows)]
    header = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        f"FIELDS {' '.join(columns)}",
        f"SIZE {' '.join(kind[1:] for kind in kinds)}",
        f"TYPE {' '.join(kind[0].upper() for kind in kinds)}",
        f"COUNT {' '.join('1' for _ in kinds)}",
        f"WIDTH {len(rows)}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(rows)}",
        "DATA binary",
    ]
    with path.open("wb") as file:
        file.write(("\n".join(header) + "\n").encode())
        file.write(rows.tobytes())


def _write_las(path: Path, points: PointMap, colours: Colours | None, crs: CRS | None) -> None:
    laspy = _laspy()
    header = laspy.LasHeader(point_format=7, version="1.4")
    header.scales = np.full(3, _LAS_SCALE_M)
    header.offsets = np.floor(points.points.min(axis=0)) if len(points) else np.zeros(3)
    if points.normals is not None:
        header.add_extra_dims([laspy.ExtraBytesParams(f"normal_{axis}", np.float32) for axis in "xyz"])
    if crs is not None:
        header.add_crs(crs)
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.points.T
    las.gps_time = points.last_s.astype(np.float64)
    if points.intensity is not None:
        las.intensity = np.round(np.clip(points.intensity, 0, 1) * np.iinfo(np.uint16).max).astype(np.uint16)
    if points.normals is not None:
        las.normal_x, las.normal_y, las.normal_z = points.normals.T
    if colours is not None:
        las.red, las.green, las.blue = colours.T.astype(np.uint16) * 257  # 255 becomes 65,535
    las.write(path)


def _laspy() -> Any:
    try:
        import laspy
    except ImportError:
        raise ConfigError("writing .las and .laz needs laspy: pip install 'hybridlio[map]'") from None
    return laspy


def _write_npz(path: Path, points: PointMap, colours: Colours | None, _crs: object) -> None:
    arrays = {name: value for name, value in vars(points).items() if value is not None}
    if colours is not None:
        arrays["colours"] = colours
    with path.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


_WRITERS = {".ply": _write_ply, ".pcd": _write_pcd, ".las": _write_las, ".laz": _write_las, ".npz": _write_npz}
FORMATS = tuple(_WRITERS)
