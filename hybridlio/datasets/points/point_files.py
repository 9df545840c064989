"""Scan files: ``.bin`` (KITTI's float32 x y z reflectance), ``.npy``, ``.pcd`` and ``.ply``.

Columns are found by name if the format has names:

* ``x y z`` in metres, lidar frame (x forward, y left, z up);
* ``intensity``, ``reflectivity`` or ``reflectance``: 0..1, or 0..255 if any value is above 1;
* ``t``, ``time``, ``timestamp`` or ``time_offset``: integers are nanoseconds, floating-point numbers seconds; relative
  to the scan's stamp or, if above 10⁶ s, absolute on the stamps' clock.

A ``.npy`` file holds a structured array with these names, or rows of x y z or x y z intensity.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridlio.core.arrays import Floats, Stamps
from hybridlio.core.errors import DataError
from hybridlio.core.sensors import NS_PER_S, Scan
from hybridlio.datasets.kitti.files import read_bin
from hybridlio.datasets.points.cloud_headers import read_header

SUFFIXES = (".bin", ".npy", ".pcd", ".ply")

_INTENSITIES = ("intensity", "reflectivity", "reflectance")
_TIMES = ("t", "time", "timestamp", "time_offset")
_MIN_ABSOLUTE_NS = 10**15  # 12 days: far above any offset, far below seconds since 1970
_MAX_OFFSET_NS = NS_PER_S  # no lidar turns slower than once a second
_MIN_SWEEP_NS = 1_000_000  # no lidar sweeps within 1 ms: the unit is wrong
Columns = dict[str, NDArray[Any]]


def read_scan(path: Path, stamp_ns: int) -> Scan:
    """Read the scan in ``path``.

    Raises:
        DataError: the file is missing or truncated, has no finite point, or has unusable columns; the message names the
            file.
    """
    points, columns = _read(path)
    try:
        scan = Scan(stamp_ns, points, _intensity(columns), _offsets_ns(columns, stamp_ns))
    except DataError as error:
        raise DataError(f"{path}: {error}") from None
    if not len(scan):
        raise DataError(f"{path}: the scan has no finite points")
    return scan


def _read(path: Path) -> tuple[NDArray[Any], Columns]:
    if not path.is_file():
        raise DataError(f"{path}: no such file")
    if path.suffix == ".bin":
        points, intensity = read_bin(path)
        return points, {"intensity": intensity}
    return _read_npy(path) if path.suffix == ".npy" else _read_open3d(path)


def _read_npy(path: Path) -> tuple[NDArray[Any], Columns]:
    try:
        values = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise DataError(f"{path}: cannot read the scan, perhaps truncated ({error})") from None
    if values.dtype.names:
        columns: Columns = {name: values[name].ravel() for name in values.dtype.names}
        if not {"x", "y", "z"} <= columns.keys():
            raise DataError(f"{path}: expected fields x y z, found {' '.join(columns)}")
        return np.column_stack([columns["x"], columns["y"], columns["z"]]), columns
    if values.ndim != 2 or values.shape[1] not in (3, 4):
        raise DataError(f"{path}: expected (N, 3) x y z or (N, 4) x y z intensity, found shape {values.shape}")
    return values[:, :3], {"intensity": values[:, 3]} if values.shape[1] == 4 else {}


def _read_open3d(path: Path) -> tuple[NDArray[Any], Columns]:
    import open3d as o3d

    header = read_header(path)
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        cloud = o3d.t.io.read_point_cloud(path)
    columns: Columns = {name: cloud.point[name].numpy() for name in cloud.point}
    if "positions" not in columns or not len(columns["positions"]):
        raise DataError(f"{path}: Open3D finds no points; the file is empty or malformed")
    lost = [name for name in header.fields if name in _TIMES and name not in columns]
    if lost:
        raise DataError(
            f"{path}: Open3D cannot read the type of the time column '{lost[0]}'; write it as int or double"
        )
    return columns.pop("positions"), {name: values.ravel() for name, values in columns.items()}


def _intensity(columns: Columns) -> Floats | None:
    values = next((columns[name] for name in _INTENSITIES if name in columns), None)
    if values is None:
        return None
    full_scale = 255 if np.max(values, where=np.isfinite(values), initial=0) > 1 else 1
    return np.asarray(values, dtype=np.float32) / np.float32(full_scale)


def _offsets_ns(columns: Columns, stamp_ns: int) -> Stamps | None:
    """Return the points' times relative to the scan's stamp; None without such a column.

    Raises:
        DataError: a time is not finite or over 1 s from the stamp, or all are within 1 ms but differ.
    """
    name = next((name for name in _TIMES if name in columns), None)
    if name is None:
        return None
    values = columns[name]
    if not np.isfinite(values).all():
        raise DataError(f"column '{name}' has times that are not finite")
    whole = np.issubdtype(values.dtype, np.integer)
    ns = values.astype(np.int64) if whole else np.round(values.astype(np.float64) * NS_PER_S).astype(np.int64)
    offsets = ns - stamp_ns if len(ns) and np.median(np.abs(ns)) > _MIN_ABSOLUTE_NS else ns
    unit = "integers are nanoseconds" if whole else "floating-point numbers are seconds"
    if len(offsets) and np.abs(offsets).max() > _MAX_OFFSET_NS:
        raise DataError(f"column '{name}' is over 1 s from the scan's stamp; {unit}, on the stamps' clock")
    if len(offsets) and 0 < np.ptp(offsets) < _MIN_SWEEP_NS:
        raise DataError(f"column '{name}' spans under 1 ms, too short for a sweep; {unit}")
    return offsets
