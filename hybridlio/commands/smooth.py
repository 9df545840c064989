"""``hybridlio smooth``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hybridlio.commands.common import Verbose, guarded
from hybridlio.commands.gps_options import Antenna, MaxShift, Outages, gps_options
from hybridlio.commands.terminal import complain, progress, say, say_table
from hybridlio.core.errors import ConfigError

if TYPE_CHECKING:
    from hybridlio.evaluation.report_data import Findings
    from hybridlio.record.record import Record
    from hybridlio.smoothing.gps_options import GpsOptions
    from hybridlio.smoothing.smoothed import Smoothed


@guarded
def smooth(
    run: Annotated[
        Path, typer.Argument(metavar="RUN", help="A run folder that `hybridlio odometry` made.", show_default=False)
    ],
    out: Annotated[
        Path | None, typer.Option("-o", "--out", metavar="DIR", help="Where to write; by default RUN/smoothed.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the run that is in -o.")] = False,
    loops: Annotated[
        bool, typer.Option("--loops", help="Find where the run comes back to a place, and close the loops.")
    ] = False,
    gps: Annotated[
        bool, typer.Option("--gps", help="Use the run's GPS fixes; their frame and their clock are found.")
    ] = False,
    antenna: Antenna = None,
    outage: Outages = None,
    max_shift: MaxShift = None,
    robust: Annotated[
        str | None,
        typer.Option(
            metavar="NAME", help="What to do about wrong loops and fixes: gnc, huber, cauchy, geman-mcclure, dcs."
        ),
    ] = None,
    _verbose: Verbose = 0,
) -> None:
    """Optimise all poses of a finished run at once, and leave the better trajectory with a report of its own."""
    from hybridlio.record.loop_keyframes import LoopKeyframes
    from hybridlio.record.record import Record
    from hybridlio.runs.folder import KEYFRAMES, RECORD, SMOOTHED, new_run_folder, read_run
    from hybridlio.runs.write import write_smoothed

    if not gps and not (antenna is None and outage is None and max_shift is None):
        raise ConfigError("--antenna, --outage and --max-shift are about GPS fixes; give --gps too")
    stored = read_run(run)
    folder = run / SMOOTHED if out is None else out
    if folder.resolve() == run.resolve():
        raise ConfigError(f"{folder} is the run itself; choose another folder with -o")
    record = Record.load(run / RECORD)
    if loops:
        record = replace(record, keyframes=LoopKeyframes.load(run / KEYFRAMES))
    start_ns = int(record.online.stamps_ns[0])
    options = gps and gps_options(antenna, max_shift, outage, start_ns)
    if out is not None:
        new_run_folder(stored.metrics["sequence"], out, overwrite)
    smoothed = _smooth(record, loops, options, robust)
    findings = write_smoothed(folder, stored, record, smoothed)
    _say_result(folder, stored.metrics["sequence"], smoothed, findings)


def _say_result(folder: Path, sequence: str, smoothed: Smoothed, findings: Findings) -> None:
    from hybridlio.evaluation.figures import evaluation_table
    from hybridlio.runs.folder import POSES, REPORT

    error = (
        f"error {smoothed.error_before:.4g} before, {smoothed.error_after:.4g} after {smoothed.iterations} iterations"
    )
    say(f"{sequence}: {len(smoothed.trajectory)} poses, {error}")
    if (closed := smoothed.found.get("loops")) is not None:
        say(f"loops: {closed.summary()}")
    if (fit := smoothed.found.get("gps")) is not None:
        say(f"GPS: {fit.summary()}")
        if fit.is_doubtful:
            complain(
                "warning: most fixes are rejected; check their sigma, the antenna and the clock (--max-shift)", "yellow"
            )
    if not smoothed.converged:
        complain("warning: the optimiser stopped before the error had stopped falling", "yellow")
    if findings.evaluations:
        say_table(evaluation_table(findings.evaluations))
    say(f"poses   {folder / POSES}")
    say(f"report  {folder / REPORT}")


def _smooth(record: Record, loops: bool, gps: bool | GpsOptions, robust: str | None) -> Smoothed:
    from hybridlio.graph.run.smooth import smooth as optimise

    with progress("smoothing", "poses") as tick:

        def show(stage: str, done: int, total: int) -> None:
            if stage == "covariances":
                tick(done + 1, total, stage)
            elif stage == "loops":
                tick(done, total, "looking for loops")
            else:
                tick(0, len(record.online), f"{stage}, round {done + 1} of {total}")

        return optimise(record, show, loops=loops, gps=gps, robust=robust)
