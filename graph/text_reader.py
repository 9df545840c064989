"""Reading pose graphs from text; see :mod:`hybridlio.graph.g2o` for what its rows hold."""

from __future__ import annotations

import logging
import os
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hybridlio.errors import DataError, GraphError, HybridLioError
from hybridlio.estimates import Array
from hybridlio.graph import coordinates as co
from hybridlio.graph.g2o import BY_ROWS, OTHER, ROWS, Row
from hybridlio.graph.keys import PLAIN_KEYS, Key, from_integer, to_integer
from hybridlio.graph.measurements import Factor, Kind, Noise, Robust, make_robust
from hybridlio.graph.pose_graph import PoseGraph

_LOG = logging.getLogger(__name__)
_OFFSET = "PARAMS_SE3OFFSET"
_UNIT_TOLERANCE = 1e-3


@dataclass(eq=False)
class _Table:
    """Rows of one tag: where they stand in the file, their keys and their numbers."""

    lines: list[int] = field(default_factory=list)
    words: list[list[str]] = field(default_factory=list)
    kernels: list[Robust | None] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class _Parsed:
    """What a text file holds."""

    tables: dict[str, _Table]
    fixed: list[int]


def read_text(path: str | os.PathLike[str]) -> PoseGraph:
    """A pose graph from g2o's or TORO's text.

    Rows of landmarks are left out, with a warning. A file with neither FIX nor prior has its pose of lowest number
    fixed, at the origin if the file has no vertices.

    Raises:
        DataError: the file cannot be read, is truncated or garbled; names the row.
    """
    path = Path(path)
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"cannot read {path}: {error}") from error
    parsed = _split(path, lines)
    dimensions = {ROWS[tag].dimension for tag in parsed.tables}
    if len(dimensions) != 1:
        found = "poses in the plane and in space" if dimensions else "no poses"
        raise DataError(f"{path}: the file holds {found}; expected VERTEX_ and EDGE_ rows of one kind")
    graph = PoseGraph(dimensions.pop())
    try:
        _add_vertices(graph, path, parsed)
        _add_factors(graph, path, parsed)
        _fix(graph, parsed.fixed)
    except GraphError as error:
        raise DataError(f"{path}: {error}") from error
    return graph


def _split(path: Path, lines: list[str]) -> _Parsed:
    parsed, left_out = _Parsed({}, []), Counter[str]()
    kernel: Robust | None = None
    for number, line in enumerate(lines, 1):
        tag, *words = line.split() or [""]
        if tag in ROWS:
            if len(words) != ROWS[tag].length:
                raise DataError(f"{path}, row {number}: {tag} takes {ROWS[tag].length} values, got {len(words)}")
            table = parsed.tables.setdefault(tag, _Table())
            table.lines.append(number)
            table.words.append(words)
            table.kernels.append(kernel)
            kernel = None
        elif tag == "#" and words[:1] == ["robust"]:
            kernel = _kernel(path, number, words)
        elif tag == "FIX":
            parsed.fixed.extend(int(word) for word in _checked_ids(path, number, words))
        elif tag == _OFFSET:
            _check_offset(path, number, words)
        elif tag in OTHER:
            left_out[tag] += 1
        elif tag and not tag.startswith("#"):
            raise DataError(f"{path}, row {number}: {tag!r} is no row of a pose graph")
    if left_out:
        _LOG.warning("%s: left out %s: poses only", path, ", ".join(f"{n} × {tag}" for tag, n in left_out.items()))
    return parsed


def _kernel(path: Path, number: int, words: list[str]) -> Robust | None:
    try:
        return make_robust((words[1], float(words[2])), 1, "kernel")
    except (IndexError, ValueError, HybridLioError) as error:
        raise DataError(f"{path}, row {number}: a kernel is '# robust NAME WIDTH' ({error})") from error


def _checked_ids(path: Path, number: int, words: list[str]) -> list[str]:
    if not "".join(words).isdecimal() or "" in words:
        raise DataError(f"{path}, row {number}: a pose's number is missing or no number: {' '.join(words)}")
    return words


def _check_offset(path: Path, number: int, words: list[str]) -> None:
    try:
        offset = [float(word) for word in words[1:]]
    except ValueError:
        offset = []
    if offset != co.IDENTITY[3].tolist():
        raise DataError(f"{path}, row {number}: priors with an offset are not known here; apply it before")


def _numbers(path: Path, tag: str, table: _Table) -> tuple[list[list[Key]], Array]:
    """Keys and the numbers ``(M, length)`` after them."""
    row = ROWS[tag]
    count = 2 if row.what == "edge" else 1
    keys: list[list[Key]] = []
    for number, words in zip(table.lines, table.words, strict=True):
        ids = list(map(int, _checked_ids(path, number, words[: row.ids])[:count]))
        if max(ids) < PLAIN_KEYS:
            keys.append([*ids])
            continue
        try:
            keys.append([from_integer(value) for value in ids])
        except GraphError as error:
            raise DataError(f"{path}, row {number}: {error}") from error
    values = _to_float(path, table.lines, [words[row.ids :] for words in table.words])
    finite = np.isfinite(values).all(axis=1)
    if not finite.all():
        raise DataError(f"{path}, row {table.lines[int(np.argmin(finite))]}: a number is not finite")
    return keys, values


def _to_float(path: Path, lines: list[int], rows: list[list[str]]) -> Array:
    try:
        return np.array(rows, dtype=np.float64)
    except ValueError:
        for number, row in zip(lines, rows, strict=True):
            for word in row:
                _check_number(path, number, word)
        raise


def _check_number(path: Path, number: int, word: str) -> None:
    try:
        float(word)
    except ValueError:
        raise DataError(f"{path}, row {number}: {word!r} is no number") from None


def _coordinates(path: Path, lines: list[int], row: Row, values: Array) -> Array:
    """Coordinates ``(M, 7)`` or ``(M, 3)`` from a row's first numbers."""
    values = values[:, : row.pose_size]
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
    """``(M, d, d)``, rotation first, from the numbers of a row."""
    size = co.TANGENT_SIZE[row.dimension]
    matrix = np.empty((len(values), size, size))
    for column, (i, j) in enumerate(row.triangle):
        matrix[:, i, j] = matrix[:, j, i] = values[:, row.pose_size + column]
    order = np.argsort(co.TEXT_ORDER[row.dimension])
    return matrix[:, order][:, :, order]


def _indefinite(information: Array) -> int | None:
    """Which matrix is the first that is not positive definite, if one is."""
    try:
        np.linalg.cholesky(information)
    except np.linalg.LinAlgError:
        return int(np.argmin(np.linalg.eigvalsh(information)[:, 0] > 0))
    return None


def _checked_information(path: Path, tag: str, table: _Table, values: Array) -> Array:
    information = _information(values, ROWS[tag])
    bad = _indefinite(information)
    if bad is not None and tag in BY_ROWS:
        by_rows = _information(values, BY_ROWS[tag])
        if _indefinite(by_rows) is None:
            return by_rows
    if bad is not None:
        raise DataError(f"{path}, row {table.lines[bad]}: the information matrix is not positive definite")
    return information


def _add_vertices(graph: PoseGraph, path: Path, parsed: _Parsed) -> None:
    for tag, table in parsed.tables.items():
        if ROWS[tag].what != "vertex":
            continue
        keys, values = _numbers(path, tag, table)
        coordinates = _coordinates(path, table.lines, ROWS[tag], values)
        for number, (key,), pose in zip(table.lines, keys, coordinates, strict=True):
            if key in graph:
                raise DataError(f"{path}, row {number}: pose {key} is there already")
            graph.put_pose(key, pose)


def _add_factors(graph: PoseGraph, path: Path, parsed: _Parsed) -> None:
    """All edges and priors in the file's order; their poses must be there if any is."""
    found: list[tuple[int, Factor]] = []
    for tag, table in parsed.tables.items():
        row = ROWS[tag]
        if row.what == "vertex":
            continue
        keys, values = _numbers(path, tag, table)
        coordinates = _coordinates(path, table.lines, row, values)
        information = _checked_information(path, tag, table, values)
        kind: Kind = "between" if row.what == "edge" else "prior"
        rows = zip(table.lines, keys, coordinates, information, table.kernels, strict=True)
        for line, of, pose, matrix, kernel in rows:
            found.append((line, Factor(kind, tuple(of), pose, Noise("information", matrix), kernel)))
    has_vertices = len(graph) > 0
    for line, factor in sorted(found, key=lambda pair: pair[0]):
        _check_keys(graph, f"{path}, row {line}", factor, has_vertices)
        graph.put_factor(factor)


def _check_keys(graph: PoseGraph, where: str, factor: Factor, has_vertices: bool) -> None:
    if len(set(factor.keys)) < len(factor.keys):
        raise DataError(f"{where}: joins pose {factor.keys[0]} to itself")
    for key in factor.keys:
        if key in graph:
            continue
        if has_vertices:
            raise DataError(f"{where}: there is no vertex {key}")
        graph.put_pose(key, None)


def _fix(graph: PoseGraph, fixed: list[int]) -> None:
    anchored = any(factor.kind == "prior" for factor in graph.factors.values())
    lowest = [] if anchored else [min(map(to_integer, graph.keys))]
    for number in fixed or lowest:
        key = from_integer(number)
        if graph.initial(key) is None:
            graph.set_initial(key, np.eye(4))
        graph.fix(key)
