"""Reader of pose graphs in text; :mod:`hybridlio.graph.formats.g2o` describes the rows."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable
from itertools import chain
from operator import itemgetter
from pathlib import Path

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError, GraphError
from hybridlio.graph.formats.g2o import ROW_FORMATS
from hybridlio.graph.formats.landmark_rows import add_observations
from hybridlio.graph.formats.load_report import LoadOptions, LoadReport
from hybridlio.graph.formats.text_rows import ParsedRows, parse_rows
from hybridlio.graph.formats.text_split import read_lines, split_by_tag
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.checks import free_motions
from hybridlio.graph.model.connectivity import components
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.model.keys import Key, from_integer, to_integer
from hybridlio.graph.model.measurements import OBSERVATIONS, Factor, Kind
from hybridlio.graph.model.noise import Noise

_LOG = logging.getLogger(__name__)


def read_text(path: str | os.PathLike[str], options: LoadOptions) -> tuple[GraphData, LoadReport]:
    """Read a pose graph from g2o's or TORO's text; a warning says what was left out or changed.

    Where neither FIX nor priors place the graph, the pose of lowest id is fixed, at the origin if the file has no
    vertices.

    Raises:
        DataError: the file cannot be read, is truncated or malformed, or holds what the options refuse; names the row.
    """
    path = Path(path)
    content = split_by_tag(path, read_lines(path), options)
    dimensions = {ROW_FORMATS[tag].dimension for tag in content.tables}
    if len(dimensions) != 1:
        found = "poses in the plane and in space" if dimensions else "no poses"
        raise DataError(f"{path}: found {found}; expected VERTEX_ and EDGE_ rows of one dimension")
    data = GraphData(dimensions.pop())
    try:
        rows = [parse_rows(path, tag, table, options.repair) for tag, table in content.tables.items()]
        _add_vertices(data, path, [part for part in rows if ROW_FORMATS[part.tag].kind == "vertex"])
        _add_landmarks(data, path, [part for part in rows if ROW_FORMATS[part.tag].kind == "landmark"])
        factors = [part for part in rows if ROW_FORMATS[part.tag].kind not in ("vertex", "landmark")]
        _add_factors(data, path, factors, content.offsets)
        _fix(data, content.fixed)
    except GraphError as error:
        raise DataError(f"{path}: {error}") from error
    report = LoadReport(dict(content.left_out), sum(part.repaired for part in rows), content.without_information)
    if report:
        _LOG.warning("%s: %s", path, report)
    return data, report


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


def _add_landmarks(data: GraphData, path: Path, parts: list[ParsedRows]) -> None:
    for part in parts:
        for line, (key,), point in zip(part.lines, part.keys, part.coordinates, strict=True):
            if key in data or key in data.landmarks:
                raise DataError(f"{path}, row {line}: vertex {key} exists already")
            data.landmarks.add(key, point)


def _add_factors(data: GraphData, path: Path, parts: list[ParsedRows], offsets: dict[int, Array]) -> None:
    """Add all edges and priors, with ids in the file's order."""
    lines = sorted(chain.from_iterable(part.lines for part in parts))
    ids = dict(zip(lines, range(len(lines)), strict=True))
    _check_keys(data, path, parts)
    edges = [part for part in parts if ROW_FORMATS[part.tag].kind == "edge"]
    if edges:
        _add_edges(data, edges, ids)
    for part in parts:
        if ROW_FORMATS[part.tag].kind in ("prior", "position"):
            _add_priors(data, part, ids, offsets)
        elif ROW_FORMATS[part.tag].kind in OBSERVATIONS:
            add_observations(data, path, part, ids, offsets)


def _add_edges(data: GraphData, parts: list[ParsedRows], ids: dict[int, int]) -> None:
    numbers = np.array([*map(ids.__getitem__, chain.from_iterable(part.lines for part in parts))])
    keys = chain.from_iterable(pair for part in parts for pair in part.keys)
    ends = np.fromiter(map(data.index.__getitem__, keys), np.int64).reshape(-1, 2)
    measured = np.concatenate([part.coordinates for part in parts])
    information = np.concatenate([part.information for part in parts])
    order = np.argsort(numbers)
    kernels = {ids[part.lines[k]]: kernel for part in parts for k, kernel in part.kernels.items()}
    data.add_edges(numbers[order], ends[order], measured[order], information[order], kernels)


def _add_priors(data: GraphData, part: ParsedRows, ids: dict[int, int], offsets: dict[int, Array]) -> None:
    columns = zip(part.lines, part.keys, part.coordinates, part.information, strict=True)
    for k, (line, keys, measured, information) in enumerate(columns):
        offset = offsets.get(part.offsets[k]) if part.offsets else None
        if offset is not None and not np.array_equal(offset, co.IDENTITY[3]):
            measured, information = _prior_of_body(measured, information, offset)
        kind: Kind = "prior"
        if ROW_FORMATS[part.tag].kind == "position":  # of the body's origin: a fix with the antenna there
            kind, measured = "gps", np.r_[measured, np.zeros(3)]
        factor = Factor(kind, keys, measured, Noise("information", information), part.kernels.get(k))
        data.add_factor(factor, ids[line])


def _prior_of_body(sensor: Array, information: Array, offset: Array) -> tuple[Array, Array]:
    """Return a prior of the body's pose from one of a sensor's, given the sensor in the body frame.

    A right perturbation ξ of the body's pose T is Ad(offset⁻¹) ξ of the sensor's pose T·offset.
    """
    T_world_sensor, T_body_sensor = co.to_matrices(np.array([sensor, offset]))
    T_sensor_body = se3.inverse(T_body_sensor)
    J = se3.adjoint(T_sensor_body)
    return co.from_matrices((T_world_sensor @ T_sensor_body)[None], 3)[0], J.T @ information @ J


def _check_keys(data: GraphData, path: Path, parts: list[ParsedRows]) -> None:
    """Check that edges join two vertices; in a file without vertices, add the poses that the factors name."""
    named = dict.fromkeys(chain.from_iterable(keys for _, keys in _named_poses(parts)))
    for part in parts:
        joined = part.keys if ROW_FORMATS[part.tag].kind == "edge" else []
        alone = next((k for k, (i, j) in enumerate(joined) if i == j), None)
        if alone is not None:
            raise DataError(f"{path}, row {part.lines[alone]}: joins pose {joined[alone][0]} to itself")
    unknown = named.keys() - data.index.keys()
    if not len(data):
        data.add_poses(list(named), np.full((len(named), len(co.IDENTITY[data.dimension])), np.nan))
    elif unknown:
        line, key = next((line, key) for line, keys in _named_poses(parts) for key in keys if key in unknown)
        raise DataError(f"{path}, row {line}: no vertex has id {key}")


def _named_poses(parts: list[ParsedRows]) -> Iterable[tuple[int, tuple[Key, ...]]]:
    """Return the line of each factor and the poses that it names, in the file's order."""
    columns = []
    for part in parts:
        observation = ROW_FORMATS[part.tag].kind in OBSERVATIONS
        poses = [keys[:1] for keys in part.keys] if observation else part.keys
        columns.append(zip(part.lines, poses, strict=True))
    return columns[0] if len(columns) == 1 else sorted(chain.from_iterable(columns), key=itemgetter(0))


def _fix(data: GraphData, fixed: list[int]) -> None:
    """Fix the poses that the file names, or the one of lowest id where nothing else anchors the graph."""
    anchored = any(factor.kind == "prior" for factor in data.other_factors.values()) or _placed_by_positions(data)
    lowest = [] if anchored else [min(map(to_integer, data.keys))]
    for number in fixed or lowest:
        (key,) = data.known_keys(from_integer(number), what="FIX")
        if data.initial_value(key) is None:
            data.set_initial(key, co.IDENTITY[data.dimension])
        data.fix(key)


def _placed_by_positions(data: GraphData) -> bool:
    """Return whether measured positions determine where the whole graph lies."""
    if not any(factor.kind == "gps" for factor in data.other_factors.values()):
        return False
    return not any(free_motions(data, part) for part in components(data))
