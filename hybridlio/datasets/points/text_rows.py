"""Reader of scans as text: one point a line, with or without names of the columns."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridlio.core.errors import DataError
from hybridlio.datasets.points.fields import Columns

SUFFIXES = (".xyz", ".asc", ".pts")
COMMON_SUFFIXES = (".txt", ".csv")  # of many other files, too: scans only in a folder of scans

_COMMENT = ("#", "//")
_MAX_HEAD_LINES = 100
_PARAVIEW = re.compile(r"points\w*:([012])")  # its columns of x, y and z
_MIN_COLUMNS, _MAX_COLUMNS = 3, 7  # without names


def read_text(path: Path) -> Columns | NDArray[Any]:
    """Read columns by name, or the ``(N, C)`` numbers of a file without names.

    Columns are separated by commas, semicolons (then decimal commas are read, too) or spaces. Names stand in a line
    before the points, also as a comment (``#``, ``//``); other lines there, such as the number of points of ``.pts``,
    and comments between points are passed over.

    Raises:
        DataError: the file has no points, a value is no number, or lines have different numbers of values.
    """
    lines = [line.strip() for line in path.read_text(encoding="utf-8", errors="replace").splitlines()]
    start = next((k for k, line in enumerate(lines[:_MAX_HEAD_LINES]) if _is_row(line)), len(lines))
    rows = [line for line in lines[start:] if line and not line.startswith(_COMMENT)]
    if not rows:
        raise DataError("holds no points: no line of three numbers or more")
    values = _numbers(rows)
    names = _names(lines[:start], values.shape[1])
    if names is not None:
        return {name: values[:, k] for k, name in enumerate(names)}
    if not _MIN_COLUMNS <= values.shape[1] <= _MAX_COLUMNS:
        raise DataError(
            f"{values.shape[1]} columns without names; write x y z to seven, or names in the first line, such as "
            "x,y,z,intensity,t"
        )
    return values


def _is_row(line: str) -> bool:
    """Return whether a line holds the numbers of a point."""
    try:
        return bool(line) and _numbers([line]).shape[1] >= _MIN_COLUMNS
    except DataError:
        return False


def _separator(line: str) -> str | None:
    return next((mark for mark in ";," if mark in line), None)


def _numbers(rows: list[str]) -> NDArray[Any]:
    mark = _separator(rows[0])
    if mark == ";":
        rows = [row.replace(",", ".") for row in rows]
    rows = [row.rstrip(mark) for row in rows] if mark else rows
    try:
        return np.loadtxt(rows, np.float64, comments=None, delimiter=mark, ndmin=2)
    except ValueError as error:
        raise DataError(f"cannot read a line as numbers ({str(error)[:120]})") from None


def _names(heads: list[str], count: int) -> list[str] | None:
    """Return the names of ``count`` columns, from the last line with that number that names x, y and z."""
    for head in reversed(heads):
        parts = re.split(r"[\s,;]+" if _separator(head) is None else rf"\s*{_separator(head)}\s*", head.lstrip("#/ "))
        names = [part.strip(' "').lower() for part in parts if part.strip(' "')]
        names = ["xyz"[int(found[1])] if (found := _PARAVIEW.fullmatch(name)) else name for name in names]
        names = [re.sub(r"\s*[\[(](m|)[\])]$", "", name) for name in names]
        if len(names) == count and {"x", "y", "z"} <= set(names):
            return names
    return None
