"""Writing pose graphs as text; see :mod:`hybridlio.graph.formats.g2o` for what its rows hold."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from typing import Literal

import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.core.errors import GraphError
from hybridlio.core.files import write_whole
from hybridlio.graph.formats.g2o import ROWS, format_numbers, information_numbers, pose_numbers
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.model.keys import Key, named, to_integer
from hybridlio.graph.model.measurements import Factor

Dialect = Literal["g2o", "toro"]

_TAGS: dict[tuple[str, int], dict[str, str]] = {
    ("g2o", 3): {"vertex": "VERTEX_SE3:QUAT", "between": "EDGE_SE3:QUAT", "prior": "EDGE_SE3_PRIOR"},
    ("g2o", 2): {"vertex": "VERTEX_SE2", "between": "EDGE_SE2", "prior": "EDGE_PRIOR_SE2"},
    ("toro", 3): {"vertex": "VERTEX3", "between": "EDGE3"},
    ("toro", 2): {"vertex": "VERTEX2", "between": "EDGE2"},
}


def write_text(data: GraphData, path: str | os.PathLike[str], dialect: Dialect) -> None:
    """Write a pose graph in g2o's format or TORO's.

    A robust kernel stands as a comment before its edge, a fixed pose as ``FIX`` unless it is the one of lowest number,
    which readers fix anyway.

    Raises:
        GraphError: the format cannot hold a factor, or some initial values are missing.
        DataError: the place cannot be written to.
    """
    tags = _TAGS[dialect, data.dimension]
    others = Counter(f.kind for f in data.others.values() if f.kind not in tags)
    if others:
        kinds = ", ".join(f"{count} × {kind}" for kind, count in others.items())
        raise GraphError(f"{path}: {dialect}'s format cannot hold {kinds}; save as .npz, which holds everything")
    lines = [*_vertices(data, tags["vertex"]), *_fixed(data)]
    if any(factor.kind == "prior" for factor in data.others.values()) and data.dimension == 3:
        lines.append(f"PARAMS_SE3OFFSET 0 {format_numbers(co.IDENTITY[3])}")
    for factor in data.factors.values():
        lines += _factor(factor, tags[factor.kind])
    write_whole(path, "\n".join(lines) + "\n")


def _vertices(data: GraphData, tag: str) -> Iterator[str]:
    """All vertices; none where no pose has an initial value but the origin that a reader gives to the first."""
    missing = [key for key in data.keys if data.coordinates(key) is None]
    given = [key for key in data.keys if data.coordinates(key) is not None]
    if missing and _lone_origin(data, given):
        return
    if missing:
        raise GraphError(f"pose {named(missing)} has no initial value to write; initialise, or pass a solution")
    for key in data.keys:
        pose = data.coordinates(key)
        assert pose is not None
        yield f"{tag} {to_integer(key)} {format_numbers(pose_numbers(pose, ROWS[tag].angles))}"


def _lone_origin(data: GraphData, given: list[Key]) -> bool:
    if not given:
        return True
    pose = data.coordinates(given[0])
    at_origin = pose is not None and np.array_equal(pose, co.IDENTITY[data.dimension])
    return len(given) == 1 and given[0] in data.fixed and at_origin


def _fixed(data: GraphData) -> list[str]:
    numbers = sorted(to_integer(key) for key in data.fixed)
    lowest = min((to_integer(key) for key in data.keys), default=None)
    has_prior = any(factor.kind == "prior" for factor in data.others.values())
    if not numbers or (numbers == [lowest] and not has_prior):
        return []
    return [f"FIX {' '.join(map(str, numbers))}"]


def _factor(factor: Factor, tag: str) -> Iterator[str]:
    assert factor.noise is not None
    row = ROWS[tag]
    ids = [to_integer(key) for key in factor.keys]
    ids += [0] * (row.ids - len(ids))  # a prior in space names its offset
    if factor.robust is not None:
        yield f"# robust {factor.robust.kernel} {factor.robust.width!r}"
    numbers: Array = np.r_[
        pose_numbers(factor.measured, row.angles), information_numbers(factor.noise.information, row)
    ]
    yield f"{tag} {' '.join(map(str, ids))} {format_numbers(numbers)}"
