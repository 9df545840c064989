"""Reading pose graphs from text; see :mod:`hybridlio.graph.formats.g2o` for what its rows hold."""

from __future__ import annotations

import logging
import os
from collections import Counter
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np

from hybridlio.core.errors import DataError, GraphError, HybridLioError
from hybridlio.graph.formats.g2o import OTHER, ROWS
from hybridlio.graph.formats.text_rows import Rows, Table, checked_ids, read_rows
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.model.keys import Key, from_integer, to_integer
from hybridlio.graph.model.measurements import Factor, Noise, Robust, make_robust

_LOG = logging.getLogger(__name__)
_OFFSET = "PARAMS_SE3OFFSET"
_COLUMNS = ("coordinates", "information")


@dataclass(frozen=True, eq=False)
class _Parsed:
    """What a text file holds."""

    tables: dict[str, Table]
    fixed: list[int]


def read_text(path: str | os.PathLike[str]) -> GraphData:
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
    graph = GraphData(dimensions.pop())
    try:
        rows = [read_rows(path, tag, table) for tag, table in parsed.tables.items()]
        _add_vertices(graph, path, [part for part in rows if ROWS[part.tag].what == "vertex"])
        _add_factors(graph, path, [part for part in rows if ROWS[part.tag].what != "vertex"])
        _fix(graph, parsed.fixed)
    except GraphError as error:
        raise DataError(f"{path}: {error}") from error
    return graph


def _split(path: Path, lines: list[str]) -> _Parsed:
    parsed, left_out = _Parsed({}, []), Counter[str]()
    kernel: Robust | None = None
    for number, line in enumerate(lines, 1):
        tag, rest = (*line.split(None, 1), "", "")[:2]
        if tag in ROWS:
            table = parsed.tables.setdefault(tag, Table())
            if kernel is not None:
                table.kernels[len(table.lines)], kernel = kernel, None
            table.lines.append(number)
            table.rests.append(rest)
        elif tag and tag not in OTHER:
            kernel = _other_row(path, number, parsed, tag, rest.split()) or kernel
        elif tag:
            left_out[tag] += 1
    if left_out:
        _LOG.warning("%s: left out %s: poses only", path, ", ".join(f"{n} × {tag}" for tag, n in left_out.items()))
    return parsed


def _other_row(path: Path, number: int, parsed: _Parsed, tag: str, words: list[str]) -> Robust | None:
    """A row that is neither pose nor factor; the kernel of the next factor where it names one."""
    if tag == "#" and words[:1] == ["robust"]:
        return _kernel(path, number, words)
    if tag == "FIX":
        parsed.fixed.extend(int(word) for word in checked_ids(path, number, words))
    elif tag == _OFFSET:
        _check_offset(path, number, words)
    elif not tag.startswith("#"):
        raise DataError(f"{path}, row {number}: {tag!r} is no row of a pose graph")
    return None


def _kernel(path: Path, number: int, words: list[str]) -> Robust | None:
    try:
        return make_robust((words[1], float(words[2])), 1, "kernel")
    except (IndexError, ValueError, HybridLioError) as error:
        raise DataError(f"{path}, row {number}: a kernel is '# robust NAME WIDTH' ({error})") from error


def _check_offset(path: Path, number: int, words: list[str]) -> None:
    try:
        offset = [float(word) for word in words[1:]]
    except ValueError:
        offset = []
    if offset != co.IDENTITY[3].tolist():
        raise DataError(f"{path}, row {number}: priors with an offset are not known here; apply it before")


def _add_vertices(graph: GraphData, path: Path, parts: list[Rows]) -> None:
    for part in parts:
        keys = [key for (key,) in part.keys]
        if len(set(keys)) < len(keys) or any(key in graph for key in keys):
            seen = set(graph.keys)
            for number, key in zip(part.lines, keys, strict=True):
                if key in seen:
                    raise DataError(f"{path}, row {number}: pose {key} is there already")
                seen.add(key)
        graph.put_poses(keys, part.coordinates)


def _add_factors(graph: GraphData, path: Path, parts: list[Rows]) -> None:
    """All edges and priors in the file's order; their poses must be there if any is."""
    rows = sorted((line, keys) for part in parts for line, keys in zip(part.lines, part.keys, strict=True))
    ids = {line: number for number, (line, _) in enumerate(rows)}
    _check_keys(graph, path, rows)
    edges = [part for part in parts if ROWS[part.tag].what == "edge"]
    if edges:
        numbers = np.array([ids[line] for part in edges for line in part.lines])
        keys = chain.from_iterable(pair for part in edges for pair in part.keys)
        ends = np.fromiter(map(graph.places.__getitem__, keys), np.int64).reshape(-1, 2)
        measured, information = (np.concatenate([getattr(part, name) for part in edges]) for name in _COLUMNS)
        order = np.argsort(numbers)
        kernels = {ids[part.lines[k]]: kernel for part in edges for k, kernel in part.kernels.items()}
        graph.put_edges(numbers[order], ends[order], measured[order], information[order], kernels)
    for part in parts:
        if ROWS[part.tag].what == "prior":
            _add_priors(graph, part, ids)


def _add_priors(graph: GraphData, part: Rows, ids: dict[int, int]) -> None:
    columns = zip(part.lines, part.keys, part.coordinates, part.information, strict=True)
    for k, (line, keys, pose, information) in enumerate(columns):
        factor = Factor("prior", keys, pose, Noise("information", information), part.kernels.get(k))
        graph.put_factor(factor, ids[line])


def _check_keys(graph: GraphData, path: Path, rows: list[tuple[int, tuple[Key, ...]]]) -> None:
    """Raise where an edge joins a pose to itself or leads nowhere; in a file without vertices, add the poses."""
    for line, keys in rows:
        if len(keys) == 2 and keys[0] == keys[1]:
            raise DataError(f"{path}, row {line}: joins pose {keys[0]} to itself")
    named = dict.fromkeys(chain.from_iterable(keys for _, keys in rows))
    unknown = named.keys() - graph.places.keys()
    if not len(graph):
        graph.put_poses(list(named), np.full((len(named), len(co.IDENTITY[graph.dimension])), np.nan))
    elif unknown:
        line, key = next((line, key) for line, keys in rows for key in keys if key in unknown)
        raise DataError(f"{path}, row {line}: there is no vertex {key}")


def _fix(graph: GraphData, fixed: list[int]) -> None:
    anchored = any(factor.kind == "prior" for factor in graph.others.values())
    lowest = [] if anchored else [min(map(to_integer, graph.keys))]
    for number in fixed or lowest:
        key = from_integer(number)
        if graph.initial(key) is None:
            graph.set_initial(key, np.eye(4))
        graph.fix(key)
