"""Fields of a point as headers of ``.pcd`` and ``.ply`` files announce them, and the columns of their data."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from hybridlio.core.errors import DataError

Columns = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Field:
    """One field of a point: name, type, and number of values."""

    name: str
    dtype: np.dtype[Any]
    count: int = 1

    @property
    def size(self) -> int:
        """Bytes of the field in each point."""
        return self.dtype.itemsize * self.count


def truncated(points: int) -> NoReturn:
    """Raise the error of a file that is shorter than its header announces.

    Raises:
        DataError: always.
    """
    raise DataError(f"truncated, the file ends before the last of its {points} points")


def binary_columns(data: bytes, fields: Sequence[Field], points: int) -> Columns:
    """Return the columns of binary data in which point follows point.

    Raises:
        DataError: ``data`` is shorter than ``points`` points.
    """
    row_bytes = sum(field.size for field in fields)
    if len(data) < points * row_bytes:
        truncated(points)
    kept = list(_named(fields))
    layout = np.dtype(
        {
            "names": [field.name for field, _, _ in kept],
            "formats": [field.dtype for field, _, _ in kept],
            "offsets": [start for _, start, _ in kept],
            "itemsize": row_bytes,
        }
    )
    rows = np.frombuffer(data, layout, count=points)
    return {field.name: rows[field.name] for field, _, _ in kept}


def blocked_columns(data: bytes, fields: Sequence[Field], points: int) -> Columns:
    """Return the columns of binary data in which field follows field, each with the values of all points.

    Raises:
        DataError: ``data`` is shorter than ``points`` points.
    """
    if len(data) < points * sum(field.size for field in fields):
        truncated(points)
    return {
        field.name: np.frombuffer(data, field.dtype, count=points, offset=start * points)
        for field, start, _ in _named(fields)
    }


def text_columns(data: bytes, fields: Sequence[Field], points: int) -> Columns:
    """Return the columns of text with one point a line.

    Raises:
        DataError: there are fewer than ``points`` lines, a line has another number of values, or a value is no number.
    """
    lines = [line for line in data.splitlines() if line.strip()][:points]
    width = sum(field.count for field in fields)
    if len(lines) < points or (lines and len(lines[-1].split()) < width):
        truncated(points)
    words = np.array(b" ".join(lines).split(), dtype=np.bytes_)
    if len(words) != points * width:
        raise DataError(f"{len(words)} values for {points} points of {width}; each line must hold one point")
    table = words.reshape(points, width)
    try:
        return {field.name: table[:, index].astype(field.dtype) for field, _, index in _named(fields)}
    except (ValueError, OverflowError) as error:
        raise DataError(f"cannot read a value as a number ({error})") from None


def _named(fields: Sequence[Field]) -> Iterator[tuple[Field, int, int]]:
    """Yield the fields to read, each with its first byte and its first value in a point.

    Padding, whose name is ``_``, fields of several values and repeated names are left out: none is a coordinate, a time
    or an intensity.
    """
    start, index, seen = 0, 0, {"_"}
    for field in fields:
        if field.count == 1 and field.name not in seen:
            seen.add(field.name)
            yield field, start, index
        start, index = start + field.size, index + field.count
