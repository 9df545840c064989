"""Rows of a pose graph's text parsed into arrays; an error names the first malformed row of the file."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hybridlio.core.arrays import Array, Mask
from hybridlio.core.errors import DataError, GraphError
from hybridlio.graph.formats.g2o import ROW_BY_ROW, ROW_FORMATS, RowFormat
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.keys import PLAIN_KEYS, Key, from_integer, lettered
from hybridlio.graph.model.noise import Robust

_UNIT_TOLERANCE = 1e-3  # of a quaternion's norm: files with three digits pass, other numbers do not
_EXACT_INTEGERS = 2**53  # a double holds all integers below it
_ROUND_VARIANCE = 1e-4  # m²: GTSAM takes variances of x and y within it as equal
_LONGEST_ID = 19  # digits of the largest signed 64-bit integer
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_NOT_FINITE = re.compile(r"[+-]?(nan|inf|infinity)", re.ASCII | re.IGNORECASE)
# Smallest eigenvalue of a repaired information matrix, relative to its largest: far above double rounding (1e-16), so
# that Cholesky succeeds, and as good as no information beside that of other factors.
_REPAIRED_EIGENVALUE = 1e-9


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
        offsets: id of the sensor's offset that each names; empty where the format has none.
        coordinates: ``(M, 7)`` or ``(M, 3)``.
        information: ``(M, d, d)``; empty for vertices.
        kernels: robust kernels by row.
        repaired: number of rows whose information matrix was not positive definite.
    """

    tag: str
    lines: list[int]
    keys: list[tuple[Key, ...]]
    offsets: list[int]
    coordinates: Array
    information: Array
    kernels: dict[int, Robust]
    repaired: int = 0


def parse_rows(path: Path, tag: str, table: TextTable, repair: bool) -> ParsedRows:
    """Parse the rows of one tag.

    Raises:
        DataError: a row is malformed; names it.
    """
    row_format = ROW_FORMATS[tag]
    if not row_format.triangle:
        heads = _parse_numbers(path, tag, table, table.rests)
        information, repaired = np.empty(0), 0
    else:
        # Poses differ from row to row, information matrices seldom do: each distinct matrix is parsed once.
        head = row_format.head
        split = [rest.split(None, head) for rest in table.rests]
        if min(map(len, split)) <= head:
            _raise_for_first_bad_row(path, tag, table)
        texts = [words[-1] for words in split]  # of the matrices
        poses = [rest[: -len(text)] for rest, text in zip(table.rests, texts, strict=True)]
        heads = _parse_numbers(path, tag, table, poses)
        number: dict[str, int] = {}
        rows = [number.setdefault(text, len(number)) for text in texts]
        matrices = _parse_numbers(path, tag, table, list(number), skipped=head)
        lines = [table.lines[k] for k in np.unique(rows, return_index=True)[1]]
        distinct, wrong = _check_information(path, tag, lines, matrices, repair)
        information, repaired = distinct[rows], int(wrong[rows].sum())
    ids = _ids(path, tag, table, heads)
    keys = _keys(path, table.lines, ids[: row_format.keys])
    offsets = ids[-1] if row_format.ids > row_format.keys else []
    if row_format.letter:  # landmarks have a numbering of their own
        keys = [(pose, lettered(row_format.letter, mark) if isinstance(mark, int) else mark) for pose, mark in keys]
    coordinates = _coordinates(path, table.lines, row_format, heads[:, row_format.ids :])
    return ParsedRows(tag, table.lines, keys, offsets, coordinates, information, table.kernels, repaired)


def _parse_numbers(path: Path, tag: str, table: TextTable, rows: list[str], skipped: int = 0) -> Array:
    """Return the numbers ``(M, n)`` of rows of text, of which each lacks the first ``skipped``."""
    row_format = ROW_FORMATS[tag]
    length = row_format.length - skipped if skipped else row_format.head
    if not all(rows):  # NumPy leaves empty rows out
        _raise_for_first_bad_row(path, tag, table)
    try:
        values = np.loadtxt(rows, comments=None, ndmin=2)
    except ValueError:
        values = np.empty((0, 0))
    if values.shape != (len(rows), length) or not np.isfinite(values).all():
        _raise_for_first_bad_row(path, tag, table)
        raise DataError(f"{path}, row {table.lines[0]}: cannot read the {tag} rows from here on")
    return values


def _raise_for_first_bad_row(path: Path, tag: str, table: TextTable) -> None:
    row_format = ROW_FORMATS[tag]
    for line, rest in zip(table.lines, table.rests, strict=True):
        words = rest.split()
        if len(words) != row_format.length:
            raise DataError(f"{path}, row {line}: {tag} takes {row_format.length} values, got {len(words)}")
        check_ids(path, line, words[: row_format.ids])
        check_numbers(path, line, words[row_format.ids :])


def check_numbers(path: Path, line: int, words: list[str]) -> Array:
    """Return the words as numbers.

    Raises:
        DataError: one is not a finite number in ASCII digits.
    """
    for word in words:
        if _NOT_FINITE.fullmatch(word):
            raise DataError(f"{path}, row {line}: numbers must be finite, got {word}")
        if not _NUMBER.fullmatch(word):
            raise DataError(f"{path}, row {line}: {word!r} is not a number")
        if not np.isfinite(float(word)):
            raise DataError(f"{path}, row {line}: numbers must be finite, got {word}")
    return np.array([float(word) for word in words])


def check_ids(path: Path, line: int, words: list[str]) -> list[str]:
    """Return the words; raise DataError where one is not the number of a pose."""
    if any(not (word.isascii() and word.isdecimal() and len(word) <= _LONGEST_ID) for word in words):
        raise DataError(f"{path}, row {line}: pose ids must be non-negative integers, got {' '.join(words)!r}")
    return words


def _ids(path: Path, tag: str, table: TextTable, numbers: Array) -> list[list[int]]:
    """Return the columns of integers; those too large for a double are parsed again."""
    count = ROW_FORMATS[tag].ids
    ids = numbers[:, :count]
    if (ids == np.floor(ids)).all() and ids.min() >= 0 and ids.max() < _EXACT_INTEGERS:
        exact: list[list[int]] = ids.T.astype(np.int64).tolist()
        return exact
    _raise_for_first_bad_row(path, tag, table)
    rows = [[int(word) for word in rest.split(None, count)[:count]] for rest in table.rests]
    return [list(column) for column in zip(*rows, strict=True)]


def _keys(path: Path, lines: list[int], ids: list[list[int]]) -> list[tuple[Key, ...]]:
    """Return the keys that each row names, from columns of integers."""
    rows = list(zip(*ids, strict=True))
    if max(map(max, ids)) < PLAIN_KEYS:
        return rows
    keys: list[tuple[Key, ...]] = []
    for line, row in zip(lines, rows, strict=True):
        try:
            keys.append(tuple(from_integer(value) for value in row))
        except GraphError as error:
            raise DataError(f"{path}, row {line}: {error}") from error
    return keys


def _coordinates(path: Path, lines: list[int], row_format: RowFormat, values: Array) -> Array:
    """Return the coordinates of poses, ``(M, 7)`` or ``(M, 3)``, or of points ``(M, d)``."""
    if row_format.values == "rpy":
        quaternions = Rotation.from_euler("ZYX", values[:, [5, 4, 3]]).as_quat(canonical=True)
        return np.hstack([values[:, :3], quaternions])
    if row_format.values == "quaternion":
        check_quaternions(path, lines, values)
    return values


def check_quaternions(path: Path, lines: list[int], values: Array) -> None:
    """Raise DataError where the quaternion of one of the coordinates ``(M, 7)`` is not of unit length."""
    bad = np.abs(np.linalg.norm(values[:, 3:], axis=1) - 1) > _UNIT_TOLERANCE
    if bad.any():
        raise DataError(f"{path}, row {lines[int(np.argmax(bad))]}: the quaternion is not of unit length")


def _check_information(path: Path, tag: str, lines: list[int], values: Array, repair: bool) -> tuple[Array, Mask]:
    """Return information matrices ``(M, d, d)``, all positive definite, and which of them were not.

    TORO's planar tags are read in the order that makes all of them positive definite.
    """
    information = _information(_as_information(values, ROW_FORMATS[tag]), ROW_FORMATS[tag])
    wrong = _not_positive_definite(information)
    if wrong.any() and tag in ROW_BY_ROW:
        row_by_row = _information(values, ROW_BY_ROW[tag])
        if not _not_positive_definite(row_by_row).any():
            if tag == "ODOMETRY":  # of GTSAM's files: the covariance
                row_by_row = np.asarray(np.linalg.inv(row_by_row), dtype=np.float64)
            return row_by_row, np.zeros_like(wrong)
    if wrong.any() and not repair:
        raise DataError(
            f"{path}, row {lines[int(np.argmax(wrong))]}: the information matrix is not positive definite; "
            "load with repair=True to take the nearest matrix that is"
        )
    for k in np.flatnonzero(wrong):
        information[k] = _nearest_positive_definite(information[k])
    return information, wrong


def _as_information(values: Array, row_format: RowFormat) -> Array:
    """Return the numbers of information matrices of bearing and range from what the rows hold.

    GTSAM's ``LANDMARK`` rows hold the variance v of x and y, taken to be that at 10 m: of the bearing v/10, of the
    range v.
    """
    if row_format.noise == "information":
        return values
    with np.errstate(divide="ignore", invalid="ignore"):
        if row_format.noise == "sigmas":
            numbers = np.where(values > 0, values**-2.0, -1.0)
        else:
            x, xy, y = values.T
            round_ = (xy == 0) & (np.abs(x - y) < _ROUND_VARIANCE) & (x > 0)
            numbers = np.where(round_, [10 / x, np.zeros(len(x)), 1 / x], -1.0).T
    return np.where(np.isfinite(numbers), numbers, -1.0)


def _information(values: Array, row_format: RowFormat) -> Array:
    """Return matrices ``(M, d, d)``, rotation first, from the numbers of their upper triangles."""
    size = 1 + max(row for row, _ in row_format.triangle)
    place = range(size) if row_format.values == "point" else co.TEXT_ORDER[row_format.dimension]
    matrix = np.empty((len(values), size, size))
    for column, (i, j) in enumerate(row_format.triangle):
        matrix[:, place[i], place[j]] = matrix[:, place[j], place[i]] = values[:, column]
    return matrix


def _not_positive_definite(information: Array) -> Mask:
    """Return which matrices ``(M, d, d)`` are not positive definite, ``(M,)``."""
    try:
        np.linalg.cholesky(information)
    except np.linalg.LinAlgError:
        return np.array([len(information) == 1 or _not_positive_definite(matrix[None])[0] for matrix in information])
    return np.zeros(len(information), dtype=bool)


def _nearest_positive_definite(matrix: Array) -> Array:
    """Return the nearest matrix, in the Frobenius norm, whose eigenvalues are all positive.

    Higham, "Computing a nearest symmetric positive semidefinite matrix" (1988): negative eigenvalues become zero, here
    a small share of the largest. A matrix without any positive eigenvalue becomes that share of its largest entry.
    """
    values, vectors = np.linalg.eigh(matrix)
    scale = values[-1] if values[-1] > 0 else max(float(np.abs(matrix).max()), 1.0)
    values = np.maximum(values, _REPAIRED_EIGENVALUE * scale)
    repaired = (vectors * values) @ vectors.T
    return np.asarray((repaired + repaired.T) / 2)
