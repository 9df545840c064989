"""``hybridlio smooth``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hybridlio.commands.common import Verbose, guarded, split_names
from hybridlio.commands.shared import completion
from hybridlio.commands.shared.gps_options import Antenna, MaxShift, Outages, gps_options
from hybridlio.commands.terminal import print_message, print_result, print_table, print_warning, progress
from hybridlio.core.errors import ConfigError, EstimationError

if TYPE_CHECKING:
    from hybridlio.evaluation.report_data import Findings
    from hybridlio.record.record import Record
    from hybridlio.runs.folder import StoredRun
    from hybridlio.smoothing.gps_options import GpsOptions
    from hybridlio.smoothing.smoothed import Smoothed

Calibrate = Annotated[
    str,
    typer.Option(
        metavar="A,B,…",
        autocompletion=completion.calibrated,
        help="Also estimate these: time_offset, extrinsics, and with --gps lever_arm, gps_clock.",
    ),
]


@guarded
def smooth(
    run: Annotated[
        Path, typer.Argument(metavar="RUN", help="A run folder written by `hybridlio odometry`.", show_default=False)
    ],
    out: Annotated[
        Path | None, typer.Option("-o", "--out", metavar="DIR", help="The folder to write to; default RUN/smoothed.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing run in -o.")] = False,
    loops: Annotated[
        bool, typer.Option("--loops", help="Detect places that the run visits again, and close the loops.")
    ] = False,
    gps: Annotated[
        bool, typer.Option("--gps", help="Use the run's GPS fixes; their frame and clock offset are estimated.")
    ] = False,
    antenna: Antenna = None,
    outage: Outages = None,
    max_shift: MaxShift = None,
    calibrate: Calibrate = "",
    robust: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            autocompletion=completion.robust_method,
            help="How to reject wrong loops and fixes: gnc, huber, cauchy, geman-mcclure, dcs.",
        ),
    ] = None,
    _verbosity: Verbose = 0,
) -> None:
    """Optimise all poses of a run together; write the smoothed trajectory and its report.

    Of a run that was killed, or still goes, the scans so far are smoothed; the default folder is then RUN-smoothed.
    """
    from hybridlio.runs.folder import SMOOTHED, is_run_folder
    from hybridlio.runs.new_folder import new_run_folder
    from hybridlio.runs.whole_folder import JOURNAL, partial_folder
    from hybridlio.runs.write import write_smoothed

    if not gps and not (antenna is None and outage is None and max_shift is None):
        raise ConfigError("--antenna, --outage and --max-shift apply to GPS fixes; give --gps too")
    is_unfinished = (partial_folder(run) / JOURNAL).is_file() and not is_run_folder(run)
    folder = out or (run.with_name(f"{run.name}-{SMOOTHED}") if is_unfinished else run / SMOOTHED)
    if folder.resolve() == run.resolve():
        raise ConfigError(f"{folder} is the run itself; choose another folder with -o")
    stored, record = _unfinished(run) if is_unfinished else _finished(run, loops)
    start_ns = int(record.online.stamps_ns[0])
    options = gps and gps_options(antenna, max_shift, outage, start_ns)
    with new_run_folder(stored.metrics["sequence"], folder, overwrite or out is None):
        smoothed = _smooth(record, loops, options, robust, split_names(calibrate))
        if smoothed.verdict.refused:
            raise EstimationError("; ".join(smoothed.verdict.doubts))
        findings = write_smoothed(folder, stored, record, smoothed)
    _print_result(folder, stored.metrics["sequence"], smoothed, findings)


def _unfinished(run: Path) -> tuple[StoredRun, Record]:
    from hybridlio.runs.unfinished.kept import read_unfinished

    stored, record = read_unfinished(run)
    print_message(f"{run} is not finished: smoothing its first {stored.metrics['frames_done']} scans", "yellow")
    return stored, record


def _finished(run: Path, loops: bool) -> tuple[StoredRun, Record]:
    """Return a run and its record, for loops with the keyframes."""
    from hybridlio.record.loop_keyframes import LoopKeyframes
    from hybridlio.record.record import Record
    from hybridlio.runs.folder import KEYFRAMES, RECORD, read_run

    stored, record = read_run(run), Record.load(run / RECORD)
    return stored, replace(record, keyframes=LoopKeyframes.load(run / KEYFRAMES)) if loops else record


def _print_result(folder: Path, sequence: str, smoothed: Smoothed, findings: Findings) -> None:
    from hybridlio.evaluation.metrics_table import metrics_table
    from hybridlio.runs.folder import POSES, REPORT

    error = f"error {smoothed.error_before:.4g} -> {smoothed.error_after:.4g} in {smoothed.iterations} iterations"
    print_result(f"{sequence}: {len(smoothed.trajectory)} poses, {error}")
    if (closed := smoothed.found.get("loops")) is not None:
        print_result(f"loops: {closed.summary()}")
    if (fit := smoothed.found.get("gps")) is not None:
        print_result(f"GPS: {fit.summary()}")
        if fit.is_doubtful:
            print_warning("most GPS fixes are rejected; check their sigma, the antenna position and --max-shift")
    if (calibrated := smoothed.found.get("calibration")) is not None:
        print_result(f"calibration: {calibrated.summary()}")
        for doubt in calibrated.doubts:
            print_warning(doubt)
    print_result(smoothed.verdict.summary())
    if not smoothed.converged:
        print_warning("the optimiser stopped at its iteration limit, before it converged")
    if findings.evaluations:
        print_table(metrics_table(findings.evaluations))
    print_result(f"poses   {folder / POSES}")
    print_result(f"report  {folder / REPORT}")


def _smooth(
    record: Record, loops: bool, gps: bool | GpsOptions, robust: str | None, calibrate: tuple[str, ...]
) -> Smoothed:  # fmt: skip
    from hybridlio.graph.run.smooth import smooth as optimise

    with progress("smoothing", "poses", {"loops": "keyframes", "optimising": "rounds"}) as report:
        return optimise(record, report, loops=loops, gps=gps, robust=robust, calibrate=calibrate)
