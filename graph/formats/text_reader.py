"""Reader of pose graphs in text; :mod:`hybridlio.graph.formats.g2o` describes the rows."""

from __future__ import annotations

import logging
import os
from collections import Counter
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np

from hybridlio.core.errors import DataError, GraphError, HybridLioError
from hybridlio.graph.formats.g2o import ROW_FORMATS, SKIPPED_TAGS
from hybridlio.graph.formats.text_rows import ParsedRows, TextTable, check_ids, parse_rows
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.model.keys import Key, from_integer, to_integer
from hybridlio.graph.model.measurements import Factor
from hybridlio.graph.model.noise import Noise, Robust, make_robust

_LOG = logging.getLogger(__name__)
_OFFSET_TAG = "PARAMS_SE3OFFSET"


@dataclass(frozen=True, eq=False)
class _FileContent:
    """A text file split by tag.

    Attributes:
        tables: rows of poses and factors by tag.
        fixed: ids of fixed poses.
    """

    tables: dict[str, TextTable]
    fixed: list[int]


def read_text(path: str | os.PathLike[str]) -> GraphData:
    """Read a pose graph from g2o's or TORO's text.

    Rows of landmarks are skipped, with a warning. Where the file has neither FIX nor a prior, the pose of lowest id is
    fixed, at the origin if the file has no vertices.

    Raises:
        DataError: the file cannot be read, is truncated or malformed; names the row.
    """
    path = Path(path)
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"cannot read {path}: {error}") from error
    content = _split(path, lines)
    dimensions = {ROW_FORMATS[tag].dimension for tag in content.tables}
    if len(dimensions) != 1:
        found = "poses in the plane and in space" if dimensions else "no poses"
        raise DataError(f"{path}: found {found}; expected VERTEX_ and EDGE_ rows of one dimension")
    data = GraphData(dimensions.pop())
    try:
        rows = [parse_rows(path, tag, table) for tag, table in content.tables.items()]
        _add_vertices(data, path, [part for part in rows if ROW_FORMATS[part.tag].kind == "vertex"])
        _add_factors(data, path, [part for part in rows if ROW_FORMATS[part.tag].kind != "vertex"])
        _fix(data, content.fixed)
    except GraphError as error:
        raise DataError(f"{path}: {error}") from error
    return data


def _split(path: Path, lines: list[str]) -> _FileContent:
    """Sort the rows by tag; a kernel in a comment belongs to the next factor."""
    content, skipped = _FileContent({}, []), Counter[str]()
    kernel: Robust | None = None
    for number, line in enumerate(lines, 1):
        tag, rest = (*line.split(None, 1), "", "")[:2]
        if tag in ROW_FORMATS:
            table = content.tables.setdefault(tag, TextTable())
            if kernel is not None:
                table.kernels[len(table.lines)], kernel = kernel, None
            table.lines.append(number)
            table.rests.append(rest)
        elif tag and tag not in SKIPPED_TAGS:
            kernel = _read_other_row(path, number, content, tag, rest.split()) or kernel
        elif tag:
            skipped[tag] += 1
    if skipped:
        _LOG.warning(
            "%s: skipped %s; only poses are read", path, ", ".join(f"{n} × {tag}" for tag, n in skipped.items())
        )
    return content


def _read_other_row(path: Path, line: int, content: _FileContent, tag: str, words: list[str]) -> Robust | None:
    """Read a row that is neither pose nor factor; return the kernel that it gives the next factor, if any."""
    if tag == "#" and words[:1] == ["robust"]:
        return _read_kernel(path, line, words)
    if tag == "FIX":
        content.fixed.extend(int(word) for word in check_ids(path, line, words))
    elif tag == _OFFSET_TAG:
        _check_offset(path, line, words)
    elif not tag.startswith("#"):
        raise DataError(f"{path}, row {line}: unknown tag {tag!r}")
    return None


def _read_kernel(path: Path, line: int, words: list[str]) -> Robust | None:
    try:
        return make_robust((words[1], float(words[2])), 1, "kernel")
    except (IndexError, ValueError, HybridLioError) as error:
        raise DataError(f"{path}, row {line}: expected a kernel '# robust NAME WIDTH' ({error})") from error


def _check_offset(path: Path, line: int, words: list[str]) -> None:
    try:
        offset = [float(word) for word in words[1:]]
    except ValueError:
        offset = []
    if offset != co.IDENTITY[3].tolist():
        raise DataError(f"{path}, row {line}: priors with an offset are not supported; apply the offset to the priors")


def _add_vertices(data: GraphData, path: Path, parts: list[ParsedRows]) -> None:
    for part in parts:
        keys = [key for (key,) in part.keys]
        if len(set(keys)) < len(keys) or any(key in data for key in keys):
            seen = set(data.keys)
            for line, key in zip(part.lines, keys, strict=True):
                if key in seen:
                    raise DataError(f"{path}, row {line}: pose {key} exists already")
                seen.add(key)
        data.add_poses(keys, part.coordinates)


def _add_factors(data: GraphData, path: Path, parts: list[ParsedRows]) -> None:
    """Add all edges and priors, with ids in the file's order."""
    rows = sorted((line, keys) for part in parts for line, keys in zip(part.lines, part.keys, strict=True))
    ids = {line: factor_id for factor_id, (line, _) in enumerate(rows)}
    _check_keys(data, path, rows)
    edges = [part for part in parts if ROW_FORMATS[part.tag].kind == "edge"]
    if edges:
        _add_edges(data, edges, ids)
    for part in parts:
        if ROW_FORMATS[part.tag].kind == "prior":
            _add_priors(data, part, ids)


def _add_edges(data: GraphData, parts: list[ParsedRows], ids: dict[int, int]) -> None:
    numbers = np.array([ids[line] for part in parts for line in part.lines])
    keys = chain.from_iterable(pair for part in parts for pair in part.keys)
    ends = np.fromiter(map(data.index.__getitem__, keys), np.int64).reshape(-1, 2)
    measured = np.concatenate([part.coordinates for part in parts])
    information = np.concatenate([part.information for part in parts])
    order = np.argsort(numbers)
    kernels = {ids[part.lines[k]]: kernel for part in parts for k, kernel in part.kernels.items()}
    data.add_edges(numbers[order], ends[order], measured[order], information[order], kernels)


def _add_priors(data: GraphData, part: ParsedRows, ids: dict[int, int]) -> None:
    columns = zip(part.lines, part.keys, part.coordinates, part.information, strict=True)
    for k, (line, keys, pose, information) in enumerate(columns):
        factor = Factor("prior", keys, pose, Noise("information", information), part.kernels.get(k))
        data.add_factor(factor, ids[line])


def _check_keys(data: GraphData, path: Path, rows: list[tuple[int, tuple[Key, ...]]]) -> None:
    """Check that edges join two vertices; in a file without vertices, add the poses that the factors name."""
    for line, keys in rows:
        if len(keys) == 2 and keys[0] == keys[1]:
            raise DataError(f"{path}, row {line}: joins pose {keys[0]} to itself")
    named = dict.fromkeys(chain.from_iterable(keys for _, keys in rows))
    unknown = named.keys() - data.index.keys()
    if not len(data):
        data.add_poses(list(named), np.full((len(named), len(co.IDENTITY[data.dimension])), np.nan))
    elif unknown:
        line, key = next((line, key) for line, keys in rows for key in keys if key in unknown)
        raise DataError(f"{path}, row {line}: no vertex has id {key}")


def _fix(data: GraphData, fixed: list[int]) -> None:
    """Fix the poses that the file names, or the one of lowest id where nothing else anchors the graph."""
    anchored = any(factor.kind == "prior" for factor in data.other_factors.values())
    lowest = [] if anchored else [min(map(to_integer, data.keys))]
    for number in fixed or lowest:
        (key,) = data.known_keys(from_integer(number), what="FIX")
        if data.initial_value(key) is None:
            data.set_initial(key, co.IDENTITY[data.dimension])
        data.fix(key)
