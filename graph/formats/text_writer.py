"""Writer of pose graphs in text; :mod:`hybridlio.graph.formats.g2o` describes the rows."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from typing import Literal

import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.core.errors import GraphError
from hybridlio.core.files import write_atomically
from hybridlio.graph.formats.g2o import ROW_FORMATS, format_numbers, information_numbers, pose_numbers
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.model.keys import Key, list_keys, to_integer
from hybridlio.graph.model.measurements import Factor

Dialect = Literal["g2o", "toro"]

_TAGS: dict[tuple[str, int], dict[str, str]] = {
    ("g2o", 3): {
        **{"vertex": "VERTEX_SE3:QUAT", "between": "EDGE_SE3:QUAT"},
        **{"prior": "EDGE_SE3_PRIOR", "position": "EDGE_SE3_PRIORXYZ"},
        **{"landmark": "VERTEX_TRACKXYZ", "point": "EDGE_SE3_TRACKXYZ"},
    },
    ("g2o", 2): {
        **{"vertex": "VERTEX_SE2", "between": "EDGE_SE2", "prior": "EDGE_PRIOR_SE2"},
        **{"landmark": "VERTEX_XY", "point": "EDGE_SE2_XY", "bearing-range": "EDGE_BEARING_RANGE_SE2_XY"},
    },
    ("toro", 3): {"vertex": "VERTEX3", "between": "EDGE3"},
    ("toro", 2): {"vertex": "VERTEX2", "between": "EDGE2"},
}


def write_text(data: GraphData, path: str | os.PathLike[str], dialect: Dialect) -> None:
    """Write a pose graph in g2o's format or TORO's.

    A robust kernel is written as a comment before its factor. Fixed poses are written as ``FIX``, unless the only one
    is that of lowest id, which readers fix anyway.

    Raises:
        GraphError: the format cannot hold a factor, or some initial values are missing.
        DataError: the file cannot be written.
    """
    tags = _TAGS[dialect, data.dimension]
    unsupported: Counter[str] = Counter(f.kind for f in data.other_factors.values() if _row_kind(f) not in tags)
    if data.origin is not None:  # text has no place on Earth to give to measured positions
        unsupported["gps"] = sum(f.kind == "gps" for f in data.other_factors.values())
    if len(data.landmarks) and "landmark" not in tags:
        unsupported["landmark"] = len(data.landmarks)
    if data.calibrations:
        unsupported["calibration"] = len(data.calibrations)
    if unsupported.total():
        kinds = ", ".join(f"{count} × {kind}" for kind, count in unsupported.items())
        raise GraphError(f"{path}: {dialect}'s format cannot hold {kinds}; save as .npz, which holds everything")
    vertices = list(_vertex_lines(data, tags["vertex"]))
    landmarks = _landmark_lines(data, tags["landmark"]) if vertices and len(data.landmarks) else ()
    lines = [*vertices, *landmarks, *_fix_lines(data)]
    if any(factor.kind in ("prior", "point") for factor in data.other_factors.values()) and data.dimension == 3:
        lines.append(f"PARAMS_SE3OFFSET 0 {format_numbers(co.IDENTITY[3])}")
    for factor in data.factors.values():
        lines += _factor_lines(factor, tags[_row_kind(factor)])
    write_atomically(path, "\n".join(lines) + "\n")


def _row_kind(factor: Factor) -> str:
    """Return the factor's kind, where a position in world is one that has no lever arm."""
    return "position" if factor.kind == "gps" and not factor.measured[3:].any() else factor.kind


def _vertex_lines(data: GraphData, tag: str) -> Iterator[str]:
    """Return all vertices, or none where no pose has an initial value but the one that a reader places by itself.

    A pose without a vertex exists for a reader only where a factor names it.
    """
    missing = [key for key in data.keys if data.initial_value(key) is None]
    given = [key for key in data.keys if data.initial_value(key) is not None]
    named = {key for factor in data.factors.values() for key in factor.keys} if missing else set()
    if missing and _is_readers_origin(data, given) and named.issuperset(data.keys):
        return
    if missing:
        raise GraphError(f"pose {list_keys(missing)} has no initial value to write; initialise, or pass a solution")
    for key in data.keys:
        pose = data.initial_value(key)
        assert pose is not None
        yield f"{tag} {to_integer(key)} {format_numbers(pose_numbers(pose, ROW_FORMATS[tag].values))}"


def _landmark_lines(data: GraphData, tag: str) -> Iterator[str]:
    missing = [key for key in data.landmarks.keys if data.landmarks.initial_value(key) is None]
    if missing:
        raise GraphError(f"landmark {list_keys(missing)} has no initial value to write; give one, or pass a solution")
    for key, point in zip(data.landmarks.keys, data.landmarks.initial_values, strict=True):
        yield f"{tag} {to_integer(key)} {format_numbers(point)}"


def _is_readers_origin(data: GraphData, given: list[Key]) -> bool:
    """Return whether the poses with initial values are at most one, fixed at the origin."""
    if not given:
        return True
    pose = data.initial_value(given[0])
    at_origin = pose is not None and np.array_equal(pose, co.IDENTITY[data.dimension])
    return len(given) == 1 and given[0] in data.fixed and at_origin


def _fix_lines(data: GraphData) -> list[str]:
    fixed = sorted(to_integer(key) for key in data.fixed)
    lowest = min((to_integer(key) for key in data.keys), default=None)
    placed = any(factor.kind in ("prior", "gps") for factor in data.other_factors.values())
    if not fixed or (fixed == [lowest] and not placed):
        return []
    return [f"FIX {' '.join(map(str, fixed))}"]


def _factor_lines(factor: Factor, tag: str) -> Iterator[str]:
    assert factor.noise is not None
    row_format = ROW_FORMATS[tag]
    ids = [to_integer(key) for key in (*factor.keys, factor.landmark) if key is not None]
    ids += [0] * (row_format.ids - len(ids))  # the id of a prior's offset in space
    if factor.robust is not None:
        yield f"# robust {factor.robust.kernel} {factor.robust.width!r}"
    measured = factor.measured[:3] if row_format.kind == "position" else factor.measured
    pose = pose_numbers(measured, row_format.values)
    numbers: Array = np.r_[pose, information_numbers(factor.noise.information, row_format)]
    yield f"{tag} {' '.join(map(str, ids))} {format_numbers(numbers)}"
