"""Which file format a pose graph is in, by its name's ending."""

from __future__ import annotations

import os
from pathlib import Path

from hybridlio.core.errors import DataError
from hybridlio.graph.formats.npz import read_npz, write_npz
from hybridlio.graph.formats.text_reader import read_text
from hybridlio.graph.formats.text_writer import write_text
from hybridlio.graph.model.graph_data import GraphData, PosesByKey


def load(path: str | os.PathLike[str]) -> GraphData:
    """Read a pose graph: ``.npz`` is ours, anything else text."""
    return read_npz(path) if Path(path).suffix == ".npz" else read_text(path)


def save(data: GraphData, path: str | os.PathLike[str], solution: PosesByKey | None) -> None:
    """Write a pose graph, with a solution's poses as initial values if one is given."""
    if solution is not None:
        data = data.without()
        data.start_from(solution)
    suffix = Path(path).suffix
    if suffix == ".npz":
        write_npz(data, path)
    elif suffix in (".g2o", ".graph", ".toro"):
        write_text(data, path, "g2o" if suffix == ".g2o" else "toro")
    else:
        raise DataError(
            f"{path}: a pose graph is saved as .npz, .g2o, .graph or .toro, not {suffix or 'without ending'}"
        )
