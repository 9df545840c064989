"""``hybridlio view``."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from hybridlio.commands.common import Verbose, guarded
from hybridlio.commands.terminal import print_result
from hybridlio.core.errors import DataError


@guarded
def view(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="A run folder.", show_default=False)],
    _verbosity: Verbose = 0,
) -> None:
    """Open a run's report in the browser, or print its path where there is no display."""
    import webbrowser

    from hybridlio.runs.folder import REPORT

    report = (run / REPORT).absolute()
    if not report.is_file():
        raise DataError(f"{report}: no such file; give a run folder written by `hybridlio odometry` or `smooth`")
    has_display = sys.platform in ("darwin", "win32") or "DISPLAY" in os.environ or "WAYLAND_DISPLAY" in os.environ
    if not (has_display and webbrowser.open(report.as_uri())):
        print_result(f"{report}")
