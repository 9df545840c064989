"""``hybridlio merge``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hybridlio.commands.common import Verbose, guarded
from hybridlio.commands.terminal import print_result, print_warning, progress
from hybridlio.core.errors import ConfigError, EstimationError
from hybridlio.core.tables import counted

if TYPE_CHECKING:
    from hybridlio.localization.merge import Merged


@guarded
def merge(
    runs: Annotated[
        list[Path], typer.Argument(metavar="RUN RUN…", help="Run folders, smoothed or not.", show_default=False)
    ],
    out: Annotated[
        Path, typer.Option("-o", "--out", metavar="MAP", help="The folder to write to.", show_default=False)
    ],
    _verbosity: Verbose = 0,
) -> None:
    """Join runs of one place by the places that they share; write each run's trajectory in the frame of the first.

    MAP holds a run folder for each run that could be joined, graph.g2o and merge.json.
    """
    from hybridlio.localization.merge import merge as merge_runs
    from hybridlio.localization.open_map import read_record
    from hybridlio.localization.write_merged import names_of, write_merged
    from hybridlio.runs.folder import read_run
    from hybridlio.runs.new_folder import claimed
    from hybridlio.runs.own_files import MERGE

    if len({run.resolve() for run in runs}) < max(len(runs), 2):
        raise ConfigError("give two different run folders or more")
    stored = [read_run(run) for run in runs]
    records, trajectories = zip(*(read_record(run) for run in runs), strict=True)
    with claimed(out, MERGE):
        with progress("merging", "pairs") as report:
            merged = merge_runs(records, trajectories, report)
        names = names_of(runs)
        _print_pairs(names, merged)
        if len(merged.unjoined) == len(runs) - 1:
            raise EstimationError(f"{names[0]}: no other run shares a place with it that several scans confirm")
        write_merged(out, stored, records, merged)
    for n in merged.unjoined:
        print_warning(f"{names[n]} is not joined: several scans must recognise a place of the others in it")
    print_result(f"{counted(len(runs) - len(merged.unjoined), 'run')} in the frame of {names[0]}")
    print_result(f"map     {out}")


def _print_pairs(names: list[str], merged: Merged) -> None:
    for pair in merged.joins:
        joins = f"{counted(len(pair.joins), 'join')}, {pair.rejected} rejected"
        print_result(f"{names[pair.earlier]} and {names[pair.later]}: {joins}")
    for name, loops in zip(names, merged.loops, strict=True):
        if loops:
            print_result(f"{name}: {counted(len(loops), 'loop')} of its own")
