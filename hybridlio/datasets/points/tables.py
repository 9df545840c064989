"""Readers of NumPy, Arrow and LAS files; the libraries of the latter two are extras."""

from __future__ import annotations

from pathlib import Path
from tokenize import TokenError
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridlio.core.errors import DataError
from hybridlio.datasets.points.fields import Columns

_LAS_COLUMNS = ("intensity", "gps_time")
_LAS_HEADER_BYTES = 227  # of version 1.0 to 1.2; version 1.4 has its count of points at byte 247
_LAS_RECORD_BYTES = 54  # at least, of a variable length record
_MAX_POINTS_PER_BYTE = 1000  # of a compressed file; only a scan of equal points comes near


def read_npy(path: Path) -> Columns | NDArray[Any]:
    """Read a ``.npy`` file: columns by name of a structured array, or the ``(N, C)`` numbers of a plain one.

    An organised cloud ``(H, W)`` or ``(H, W, C)`` becomes one row a point.

    Raises:
        DataError: the file is truncated or no array of numbers, or has another shape.
    """
    try:
        values = np.load(path, mmap_mode="r", allow_pickle=False)  # mapped: nothing is allocated that is not there
    except (OSError, ValueError, EOFError, OverflowError, MemoryError, SyntaxError, TokenError) as error:
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

    read = feather.read_table if path.suffix.lower() == ".feather" else parquet.read_table
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


@np.errstate(invalid="ignore", over="ignore")  # damaged files hold any scale
def read_las(path: Path) -> Columns:
    """Read coordinates in metres, intensity and GPS time of a ``.las`` or ``.laz`` file.

    Raises:
        DataError: the file is malformed, or laspy is not installed.
    """
    laspy = _extra("laspy", "las")
    _check_las_size(path)
    try:
        # one thread: the parallel decompressor trusts sizes in the table of chunks
        las = laspy.read(path, laz_backend=laspy.LazBackend.Lazrs if path.suffix.lower() == ".laz" else None)
        names = [name for name in _LAS_COLUMNS if name in las.point_format.dimension_names]
        columns = {axis: np.asarray(getattr(las, axis), np.float64) for axis in "xyz"}
        return columns | {name: np.asarray(las[name]) for name in names}
    except BaseException as error:  # laspy raises errors of many kinds on damaged files, its decompressor a panic
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        raise DataError(f"cannot read the points, perhaps truncated ({error})") from None


def _check_las_size(path: Path) -> None:
    """Compare the points and chunks that a LAS file announces with its size, before memory is taken.

    The decompressor aborts the process where a damaged table announces too many chunks.

    Raises:
        DataError: the file is too short, or its table of chunks is damaged.
    """
    content = path.read_bytes()
    header = content[: _LAS_HEADER_BYTES + 28]
    if header[:4] != b"LASF" or len(header) < _LAS_HEADER_BYTES:
        raise DataError("cannot read the header; the file is truncated, or no .las file")
    start, kind, width = (int.from_bytes(header[a:b], "little") for a, b in ((96, 100), (104, 105), (105, 107)))
    counts = int.from_bytes(header[107:111], "little"), int.from_bytes(header[247:255], "little")
    count = max(counts) if header[25] >= 4 else counts[0]
    room = len(content) - start
    compressed = kind >= 128
    if room < 0 or count > (room * _MAX_POINTS_PER_BYTE if compressed else room // max(width, 1)):
        raise DataError(f"truncated, the file is too short for the {count} points that it announces")
    records = int.from_bytes(header[100:104], "little"), int.from_bytes(header[243:247], "little")
    if records[0] * _LAS_RECORD_BYTES > start or (header[25] >= 4 and records[1] * _LAS_RECORD_BYTES > len(content)):
        raise DataError("cannot read the header; it announces more records than the file holds")
    if compressed and count:
        # the position of the table comes before the points, or last if the writer could not go back
        places = (int.from_bytes(part, "little", signed=True) for part in (content[start : start + 8], content[-8:]))
        table = next((place for place in places if place != -1), -1)
        chunks = int.from_bytes(content[table + 4 : table + 8], "little") if table >= start else 0
        if not 0 < chunks <= count:
            raise DataError("truncated, or its table of chunks is damaged")


def _extra(module: str, extra: str) -> ModuleType:
    """Import a library that only some users need."""
    from importlib import import_module

    try:
        return import_module(module)
    except ImportError:
        raise DataError(f"needs {module}: pip install 'hybridlio[{extra}]'") from None
