"""Observations of landmarks from rows of text."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.graph.formats.g2o import ROW_FORMATS
from hybridlio.graph.formats.text_rows import ParsedRows
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.model.measurements import Factor, Kind
from hybridlio.graph.model.noise import Noise


def add_observations(
    data: GraphData, path: Path, part: ParsedRows, ids: dict[int, int], offsets: dict[int, Array]
) -> None:
    """Add the observations of one tag, and their landmarks where the file has no vertices of landmarks.

    Args:
        data: the graph, with all poses.
        path: of the file.
        part: the rows.
        ids: factor id by row of the file.
        offsets: coordinates of sensors in the body frame, by id.

    Raises:
        DataError: an unknown landmark, or a point that coincides with its pose; names the row.
    """
    tag, kind = ROW_FORMATS[part.tag], _kind(part.tag)
    listed = len(data.landmarks) > 0 and not tag.letter
    for k, (line, (pose, landmark)) in enumerate(zip(part.lines, part.keys, strict=True)):
        if landmark in data:
            raise DataError(f"{path}, row {line}: vertex {landmark} is a pose, not a landmark")
        if landmark not in data.landmarks:
            if listed:
                raise DataError(f"{path}, row {line}: no vertex has id {landmark}")
            data.landmarks.add(landmark)
        measured, information = part.coordinates[k], part.information[k]
        offset = offsets.get(part.offsets[k]) if part.offsets else None
        if offset is not None:
            measured, information = _in_body(measured, information, offset)
        if part.tag == "LANDMARK":
            measured = np.array([np.arctan2(measured[1], measured[0]), np.hypot(*measured)])
        if not (measured.any() if kind == "point" else measured[1] > 0):
            raise DataError(f"{path}, row {line}: the landmark lies at the pose itself, so that it has no bearing")
        noise = Noise("information", information)
        factor = Factor(kind, (pose,), measured, noise, part.kernels.get(k), landmark=landmark)
        data.add_factor(factor, ids[line])


def _kind(tag: str) -> Kind:
    return "point" if ROW_FORMATS[tag].kind == "point" else "bearing-range"


def _in_body(point: Array, information: Array, offset: Array) -> tuple[Array, Array]:
    """Return a point and its information in the body frame from those in a sensor's frame."""
    T_body_sensor = co.to_matrices(offset[None])[0]
    R = T_body_sensor[:3, :3]
    return R @ point + T_body_sensor[:3, 3], R @ information @ R.T
