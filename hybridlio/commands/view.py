"""``hybridlio view``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hybridlio.commands import common
from hybridlio.commands.common import guarded
from hybridlio.commands.terminal import print_message, print_result, progress
from hybridlio.core.errors import DataError
from hybridlio.core.tables import counted


@guarded
def view(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="A run folder, smoothed or not.", show_default=False)],
    save: Annotated[
        Path | None, typer.Option("--save", metavar="FILE.rrd", help="Write a file for the viewer, without opening it.")
    ] = None,
    data: Annotated[
        Path | None, typer.Option("--data", metavar="DATA", help="The recording, if it is not where the run found it.")
    ] = None,
    overwrite: common.Overwrite = False,
    scans: Annotated[
        bool, typer.Option("--scans/--no-scans", help="Show the points of every scan, read from the recording.")
    ] = True,
    report: Annotated[
        bool, typer.Option("--report", help="Open the run's report in the browser instead, or print its path.")
    ] = False,
    _verbosity: common.Verbose = 0,
) -> None:
    """Show a run in the Rerun viewer: map, path, scans, uncertainty, biases, loops and GPS over time."""
    if report:
        _open_report(run)
        return
    from hybridlio.datasets.protection import check_new_file
    from hybridlio.viewing.rerun_stream import check_target
    from hybridlio.viewing.view import view as show

    check_target(save)
    if save is not None:
        check_new_file(save, overwrite, *([] if data is None else [data]))
    with progress("view") as reported:
        scene = show(run, save, data=data, scans=scans, progress=reported)
    for note in scene.left_out:
        print_message(note, "yellow")
    print_result(f"{scene.name}: {counted(len(scene.scans), 'scan')}")
    if save is not None:
        print_result(f"view    {save}")


def _open_report(run: Path) -> None:
    import webbrowser

    from hybridlio.runs.folder import REPORT
    from hybridlio.viewing.rerun_stream import has_display

    path = (run / REPORT).absolute()
    if not path.is_file():
        raise DataError(f"{path}: no such file; give a run folder written by `hybridlio odometry` or `smooth`")
    if not (has_display() and webbrowser.open(path.as_uri())):
        print_result(f"{path}")
