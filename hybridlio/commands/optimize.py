"""``hybridlio optimize``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hybridlio.commands.common import Overwrite, Verbose, guarded
from hybridlio.commands.shared import completion
from hybridlio.commands.terminal import print_result, print_warning


@guarded
def optimize(
    graph: Annotated[
        Path, typer.Argument(metavar="IN", help="The pose graph: .g2o, .graph or .npz.", show_default=False)
    ],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="OUT", help="Where to write the solved graph.")
    ] = None,
    solver: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            autocompletion=completion.solver,
            help="batch, gnc (rejects wrong loops), incremental or fixed-lag.",
        ),
    ] = "batch",
    plot: Annotated[
        Path | None, typer.Option(metavar="PNG", help="Where to draw it, with factors coloured by their χ².")
    ] = None,
    overwrite: Overwrite = False,
    _verbosity: Verbose = 0,
) -> None:
    """Find the poses that fit a pose graph's factors best."""
    from hybridlio.datasets.protection import check_new_file
    from hybridlio.graph.pose_graph import PoseGraph

    for path in (output, plot):
        if path is not None:
            check_new_file(path, overwrite)
    loaded = PoseGraph.load(graph)
    solution = loaded.optimize(solver)  # type: ignore[arg-type]  # checked by optimize
    if output is not None:
        loaded.save(output, solution)
    if plot is not None:
        solution.plot().savefig(plot, dpi=150)
    print_result(repr(solution).strip("<>"))
    for reason in solution.doubtful:
        print_warning(f"doubtful: {reason}")
