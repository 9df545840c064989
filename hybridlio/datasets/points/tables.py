"""Readers of NumPy, Arrow and LAS files; the libraries of the latter two are extras."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridlio.core.errors import DataError
from hybridlio.datasets.points.fields import Columns

_LAS_COLUMNS = ("intensity", "gps_time")


def read_npy(path: Path) -> Columns | NDArray[Any]:
    """Read a ``.npy`` file: columns by name of a structured array, or the ``(N, C)`` numbers of a plain one.

    An organised cloud ``(H, W)`` or ``(H, W, C)`` becomes one row a point.

    Raises:
        DataError: the file is truncated or no array of numbers, or has another shape.
    """
    try:
        values = np.load(path, mmap_mode="r", allow_pickle=False)  # mapped: nothing is allocated that is not there
    except (OSError, ValueError, EOFError, OverflowError, MemoryError) as error:
        raise DataError(f"cannot read the scan, perhaps truncated ({error})") from None
    if not isinstance(values, np.ndarray):
        raise DataError("an archive of arrays; write one array a scan")
    if values.dtype.names:
        return {name: np.array(values[name]).ravel() for name in values.dtype.names if values.dtype[name].shape == ()}
    if values.ndim not in (2, 3) or not 3 <= values.shape[-1] <= 7 or values.dtype.kind not in "iuf":
        raise DataError(f"expected (N, 3) x y z to (N, 7), or a structured array, found shape {values.shape}")
    return np.array(values).reshape(-1, values.shape[-1])


def read_arrow(path: Path) -> Columns:
    """Read the columns of numbers of a ``.feather`` or ``.parquet`` file.

    Raises:
        DataError: the file is malformed, or pyarrow is not installed.
    """
    _extra("pyarrow", "arrow")
    import pyarrow
    from pyarrow import feather, parquet

    read = feather.read_table if path.suffix == ".feather" else parquet.read_table
    try:
        table = read(path)
        columns = {
            name: table.column(name).to_numpy()
            for name, kind in zip(table.column_names, table.schema.types, strict=True)
            if pyarrow.types.is_integer(kind) or pyarrow.types.is_floating(kind)
        }
    except (pyarrow.ArrowException, OSError, ValueError, NotImplementedError) as error:
        raise DataError(f"cannot read the table, perhaps truncated ({str(error).splitlines()[0]})") from None
    return columns


def read_las(path: Path) -> Columns:
    """Read coordinates in metres, intensity and GPS time of a ``.las`` or ``.laz`` file.

    Raises:
        DataError: the file is malformed, or laspy is not installed.
    """
    laspy = _extra("laspy", "las")
    try:
        las = laspy.read(path)
        names = [name for name in _LAS_COLUMNS if name in las.point_format.dimension_names]
        columns = {axis: np.asarray(getattr(las, axis), np.float64) for axis in "xyz"}
        return columns | {name: np.asarray(las[name]) for name in names}
    except Exception as error:  # laspy and its decompressor raise errors of many kinds on damaged files
        raise DataError(f"cannot read the points, perhaps truncated ({error})") from None


def _extra(module: str, extra: str) -> ModuleType:
    """Import a library that only some users need."""
    from importlib import import_module

    try:
        return import_module(module)
    except ImportError:
        raise DataError(f"needs {module}: pip install 'hybridlio[{extra}]'") from None
