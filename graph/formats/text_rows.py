"""Rows of a pose graph's text parsed into arrays; an error names the first malformed row of the file."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError, GraphError
from hybridlio.graph.formats.g2o import ROW_BY_ROW, ROW_FORMATS, RowFormat
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.keys import PLAIN_KEYS, Key, from_integer
from hybridlio.graph.model.noise import Robust

_UNIT_TOLERANCE = 1e-3  # of a quaternion's norm: files with three digits pass, other numbers do not
_EXACT_INTEGERS = 2**53  # a double holds all integers below it


@dataclass(eq=False)
class TextTable:
    """Rows of one tag as text.

    Attributes:
        lines: line numbers in the file.
        rests: what follows the tag in each.
        kernels: robust kernels by position in the table.
    """

    lines: list[int] = field(default_factory=list)
    rests: list[str] = field(default_factory=list)
    kernels: dict[int, Robust] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class ParsedRows:
    """Rows of one tag as arrays.

    Attributes:
        tag: theirs.
        lines: line numbers in the file.
        keys: of the poses that each names.
        coordinates: ``(M, 7)`` or ``(M, 3)``.
        information: ``(M, d, d)``; empty for vertices.
        kernels: robust kernels by row.
    """

    tag: str
    lines: list[int]
    keys: list[tuple[Key, ...]]
    coordinates: Array
    information: Array
    kernels: dict[int, Robust]


def parse_rows(path: Path, tag: str, table: TextTable) -> ParsedRows:
    """Parse the rows of one tag.

    Raises:
        DataError: a row is malformed; names it.
    """
    row_format = ROW_FORMATS[tag]
    if not row_format.triangle:
        numbers = _parse_numbers(path, tag, table, table.rests)
        ids, values = _ids(path, tag, table, numbers), numbers[:, row_format.ids :]
        coordinates = _coordinates(path, table.lines, row_format, values)
        return ParsedRows(tag, table.lines, _keys(path, table.lines, ids), coordinates, np.empty(0), table.kernels)
    # Poses differ from row to row, information matrices seldom do: each distinct matrix is parsed once.
    head = row_format.ids + row_format.pose_size
    split = [rest.split(None, head) for rest in table.rests]
    if any(len(words) <= head for words in split):
        _raise_for_first_bad_row(path, tag, table)
    heads = _parse_numbers(path, tag, table, [" ".join(words[:-1]) for words in split])
    last_row = {words[-1]: k for k, words in enumerate(split)}  # by the matrix's text
    number = {text: k for k, text in enumerate(last_row)}
    matrices = _parse_numbers(path, tag, table, list(last_row), skipped=head)
    lines = [table.lines[k] for k in last_row.values()]
    information = _check_information(path, tag, lines, matrices)[[number[words[-1]] for words in split]]
    coordinates = _coordinates(path, table.lines, row_format, heads[:, row_format.ids :])
    keys = _keys(path, table.lines, _ids(path, tag, table, heads))
    return ParsedRows(tag, table.lines, keys, coordinates, information, table.kernels)


def _parse_numbers(path: Path, tag: str, table: TextTable, rows: list[str], skipped: int = 0) -> Array:
    """Return the numbers ``(M, n)`` of rows of text, of which each lacks the first ``skipped``."""
    row_format = ROW_FORMATS[tag]
    only_head = row_format.triangle and not skipped
    length = row_format.ids + row_format.pose_size if only_head else row_format.length
    try:
        values = np.loadtxt(rows, comments=None, ndmin=2)
    except ValueError:
        _raise_for_first_bad_row(path, tag, table)
        raise
    if values.shape != (len(rows), length - skipped) or not np.isfinite(values).all():
        _raise_for_first_bad_row(path, tag, table)
        raise DataError(f"{path}: {tag} rows cannot be read")
    return values


def _raise_for_first_bad_row(path: Path, tag: str, table: TextTable) -> None:
    row_format = ROW_FORMATS[tag]
    for line, rest in zip(table.lines, table.rests, strict=True):
        words = rest.split()
        if len(words) != row_format.length:
            raise DataError(f"{path}, row {line}: {tag} takes {row_format.length} values, got {len(words)}")
        check_ids(path, line, words[: row_format.ids])
        for word in words[row_format.ids :]:
            _check_number(path, line, word)


def _check_number(path: Path, line: int, word: str) -> None:
    try:
        value = float(word)
    except ValueError:
        raise DataError(f"{path}, row {line}: {word!r} is not a number") from None
    if not np.isfinite(value):
        raise DataError(f"{path}, row {line}: numbers must be finite, got {word}")


def check_ids(path: Path, line: int, words: list[str]) -> list[str]:
    """Return the words; raise DataError where one is not the number of a pose."""
    if not "".join(words).isdecimal() or "" in words:
        raise DataError(f"{path}, row {line}: pose ids must be non-negative integers, got {' '.join(words)!r}")
    return words


def _ids(path: Path, tag: str, table: TextTable, numbers: Array) -> list[list[int]]:
    """Return the pose ids of each row; those too large for a double are parsed again, as integers."""
    count, ids = 2 if ROW_FORMATS[tag].kind == "edge" else 1, numbers[:, : ROW_FORMATS[tag].ids]
    if (ids == np.floor(ids)).all() and ids.min() >= 0 and ids.max() < _EXACT_INTEGERS:
        exact: list[list[int]] = ids[:, :count].astype(np.int64).tolist()
        return exact
    _raise_for_first_bad_row(path, tag, table)
    return [[int(word) for word in rest.split(None, count)[:count]] for rest in table.rests]


def _keys(path: Path, lines: list[int], ids: list[list[int]]) -> list[tuple[Key, ...]]:
    if max(map(max, ids)) < PLAIN_KEYS:
        return [tuple(row) for row in ids]
    keys: list[tuple[Key, ...]] = []
    for line, row in zip(lines, ids, strict=True):
        try:
            keys.append(tuple(from_integer(value) for value in row))
        except GraphError as error:
            raise DataError(f"{path}, row {line}: {error}") from error
    return keys


def _coordinates(path: Path, lines: list[int], row_format: RowFormat, values: Array) -> Array:
    """Return coordinates ``(M, 7)`` or ``(M, 3)`` from the numbers of poses."""
    if row_format.angles == "heading":
        return values
    if row_format.angles == "rpy":
        quaternions = Rotation.from_euler("ZYX", values[:, [5, 4, 3]]).as_quat(canonical=True)
        return np.hstack([values[:, :3], quaternions])
    bad = np.abs(np.linalg.norm(values[:, 3:], axis=1) - 1) > _UNIT_TOLERANCE
    if bad.any():
        raise DataError(f"{path}, row {lines[int(np.argmax(bad))]}: the quaternion is not of unit length")
    return values


def _check_information(path: Path, tag: str, lines: list[int], values: Array) -> Array:
    """Return information matrices ``(M, d, d)``; TORO's planar tags in the order that makes all positive definite."""
    information = _information(values, ROW_FORMATS[tag])
    bad = _first_indefinite(information)
    if bad is not None and tag in ROW_BY_ROW:
        row_by_row = _information(values, ROW_BY_ROW[tag])
        if _first_indefinite(row_by_row) is None:
            return row_by_row
    if bad is not None:
        raise DataError(f"{path}, row {lines[bad]}: the information matrix is not positive definite")
    return information


def _information(values: Array, row_format: RowFormat) -> Array:
    """Return matrices ``(M, d, d)``, rotation first, from the numbers of their upper triangles."""
    size = co.TANGENT_SIZE[row_format.dimension]
    matrix = np.empty((len(values), size, size))
    for column, (i, j) in enumerate(row_format.triangle):
        matrix[:, i, j] = matrix[:, j, i] = values[:, column]
    order = np.argsort(co.TEXT_ORDER[row_format.dimension])
    return matrix[:, order][:, :, order]


def _first_indefinite(information: Array) -> int | None:
    """Return the index of the first matrix that is not positive definite, or None."""
    try:
        np.linalg.cholesky(information)
    except np.linalg.LinAlgError:
        return int(np.argmin(np.linalg.eigvalsh(information)[:, 0] > 0))
    return None
