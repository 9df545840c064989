"""Rows of a pose graph's text as arrays; where something is wrong with one, its place in the file is told."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError, GraphError
from hybridlio.graph.formats.g2o import BY_ROWS, ROWS, Row
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.keys import PLAIN_KEYS, Key, from_integer
from hybridlio.graph.model.measurements import Robust

_UNIT_TOLERANCE = 1e-3
_EXACT = 2**53  # integers below it are doubles


@dataclass(eq=False)
class Table:
    """Rows of one tag: where they stand in the file, what follows the tag, and kernels by place in the table."""

    lines: list[int] = field(default_factory=list)
    rests: list[str] = field(default_factory=list)
    kernels: dict[int, Robust] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Rows:
    """Rows of one tag as arrays: lines in the file, keys, coordinates, information (of none for vertices)."""

    tag: str
    lines: list[int]
    keys: list[tuple[Key, ...]]
    coordinates: Array
    information: Array
    kernels: dict[int, Robust]


def read_rows(path: Path, tag: str, table: Table) -> Rows:
    """Rows as arrays: first the numbers of all poses, then those of each information matrix that differs."""
    row = ROWS[tag]
    if not row.triangle:
        numbers = _numbers(path, tag, table, table.rests)
        ids, coordinates = _ids(path, tag, table, numbers), _coordinates(path, table.lines, row, numbers[:, row.ids :])
        return Rows(tag, table.lines, _keys(path, table.lines, ids), coordinates, np.empty(0), table.kernels)
    split = [rest.split(None, row.ids + row.pose_size) for rest in table.rests]
    if any(len(words) <= row.ids + row.pose_size for words in split):
        _explain(path, tag, table)
    heads = _numbers(path, tag, table, [" ".join(words[:-1]) for words in split])
    place = {words[-1]: k for k, words in enumerate(split)}  # many edges share one matrix
    number = {tail: k for k, tail in enumerate(place)}
    shared = _numbers(path, tag, table, list(place), row.ids + row.pose_size)
    lines = [table.lines[k] for k in place.values()]
    information = _checked_information(path, tag, lines, shared)[[number[words[-1]] for words in split]]
    coordinates = _coordinates(path, table.lines, row, heads[:, row.ids :])
    keys = _keys(path, table.lines, _ids(path, tag, table, heads))
    return Rows(tag, table.lines, keys, coordinates, information, table.kernels)


def _numbers(path: Path, tag: str, table: Table, rows: list[str], before: int = 0) -> Array:
    """Numbers ``(M, n)`` of rows of text; where anything is wrong with one, the file's row is told.

    ``before`` says how many of a row's numbers stand elsewhere.
    """
    whole = ROWS[tag].ids + ROWS[tag].pose_size if ROWS[tag].triangle and not before else ROWS[tag].length
    try:
        values = np.loadtxt(rows, comments=None, ndmin=2)
    except ValueError:
        _explain(path, tag, table)
        raise
    if values.shape != (len(rows), whole - before) or not np.isfinite(values).all():
        _explain(path, tag, table)
        raise DataError(f"{path}: {tag} rows cannot be read")
    return values


def _explain(path: Path, tag: str, table: Table) -> None:
    """Raise for the first row that is wrong."""
    row = ROWS[tag]
    for number, rest in zip(table.lines, table.rests, strict=True):
        words = rest.split()
        if len(words) != row.length:
            raise DataError(f"{path}, row {number}: {tag} takes {row.length} values, got {len(words)}")
        checked_ids(path, number, words[: row.ids])
        for word in words[row.ids :]:
            _check_number(path, number, word)


def _check_number(path: Path, number: int, word: str) -> None:
    try:
        value = float(word)
    except ValueError:
        raise DataError(f"{path}, row {number}: {word!r} is no number") from None
    if not np.isfinite(value):
        raise DataError(f"{path}, row {number}: a number is not finite")


def _ids(path: Path, tag: str, table: Table, numbers: Array) -> list[list[int]]:
    """Numbers of the poses of each row; beyond what a double holds they are read once more, as integers."""
    count, ids = 2 if ROWS[tag].what == "edge" else 1, numbers[:, : ROWS[tag].ids]
    if (ids == np.floor(ids)).all() and ids.min() >= 0 and ids.max() < _EXACT:
        exact: list[list[int]] = ids[:, :count].astype(np.int64).tolist()
        return exact
    _explain(path, tag, table)
    return [[int(word) for word in rest.split(None, count)[:count]] for rest in table.rests]


def _keys(path: Path, lines: list[int], ids: list[list[int]]) -> list[tuple[Key, ...]]:
    if max(map(max, ids)) < PLAIN_KEYS:
        return [tuple(row) for row in ids]
    keys: list[tuple[Key, ...]] = []
    for number, row in zip(lines, ids, strict=True):
        try:
            keys.append(tuple(from_integer(value) for value in row))
        except GraphError as error:
            raise DataError(f"{path}, row {number}: {error}") from error
    return keys


def _coordinates(path: Path, lines: list[int], row: Row, values: Array) -> Array:
    """Coordinates ``(M, 7)`` or ``(M, 3)`` from a row's first numbers."""
    if row.angles == "heading":
        return values
    if row.angles == "rpy":
        quaternions = Rotation.from_euler("ZYX", values[:, [5, 4, 3]]).as_quat(canonical=True)
        return np.hstack([values[:, :3], quaternions])
    off = np.abs(np.linalg.norm(values[:, 3:], axis=1) - 1) > _UNIT_TOLERANCE
    if off.any():
        raise DataError(f"{path}, row {lines[int(np.argmax(off))]}: the quaternion is not of unit length")
    return values


def _information(values: Array, row: Row) -> Array:
    """``(M, d, d)``, rotation first, from the numbers of their upper triangles."""
    size = co.TANGENT_SIZE[row.dimension]
    matrix = np.empty((len(values), size, size))
    for column, (i, j) in enumerate(row.triangle):
        matrix[:, i, j] = matrix[:, j, i] = values[:, column]
    order = np.argsort(co.TEXT_ORDER[row.dimension])
    return matrix[:, order][:, :, order]


def _indefinite(information: Array) -> int | None:
    """Which matrix is the first that is not positive definite, if one is."""
    try:
        np.linalg.cholesky(information)
    except np.linalg.LinAlgError:
        return int(np.argmin(np.linalg.eigvalsh(information)[:, 0] > 0))
    return None


def _checked_information(path: Path, tag: str, lines: list[int], values: Array) -> Array:
    information = _information(values, ROWS[tag])
    bad = _indefinite(information)
    if bad is not None and tag in BY_ROWS:
        by_rows = _information(values, BY_ROWS[tag])
        if _indefinite(by_rows) is None:
            return by_rows
    if bad is not None:
        raise DataError(f"{path}, row {lines[bad]}: the information matrix is not positive definite")
    return information


def checked_ids(path: Path, number: int, words: list[str]) -> list[str]:
    """Words that are numbers of poses; raises DataError for others."""
    if not "".join(words).isdecimal() or "" in words:
        raise DataError(f"{path}, row {number}: a pose's number is missing or no number: {' '.join(words)}")
    return words
