"""Choice of a pose graph's file format by the file name's ending."""

from __future__ import annotations

import os

from hybridlio.core.errors import DataError
from hybridlio.core.files import user_path
from hybridlio.graph.formats.load_report import LoadOptions, LoadReport
from hybridlio.graph.formats.npz import read_npz, write_npz
from hybridlio.graph.formats.text_reader import read_text
from hybridlio.graph.formats.text_writer import write_text
from hybridlio.graph.model.graph_data import GraphData, PosesByKey
from hybridlio.graph.model.new_factors import check_start


def read_graph(path: str | os.PathLike[str], options: LoadOptions) -> tuple[GraphData, LoadReport]:
    """Read a pose graph: ``.npz``, or text (g2o's or TORO's) under any other ending; the options concern text.

    Raises:
        DataError: the file is missing, truncated or malformed; names the row of text.
    """
    path = user_path(path)
    return (read_npz(path), LoadReport()) if path.suffix == ".npz" else read_text(path, options)


def write_graph(data: GraphData, path: str | os.PathLike[str], solution: PosesByKey | None) -> None:
    """Write a pose graph, with a solution's poses as initial values if one is given.

    Raises:
        DataError: unknown ending, or the file cannot be written.
        GraphError: the format cannot hold what is in the graph.
    """
    path = user_path(path)
    if solution is not None:
        data = data.copy()
        data.start_from(check_start(data, solution))
    suffix = path.suffix
    if suffix == ".npz":
        write_npz(data, path)
    elif suffix in (".g2o", ".graph", ".toro"):
        write_text(data, path, "g2o" if suffix == ".g2o" else "toro")
    else:
        raise DataError(
            f"{path}: cannot save a pose graph under the ending {suffix or '(none)'}; use .npz, .g2o, .graph or .toro"
        )
