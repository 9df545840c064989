"""``hybridlio odometry``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hybridlio.commands import common
from hybridlio.commands.common import PartialResultError, guarded
from hybridlio.commands.terminal import print_message, print_result, print_table, print_warning, progress
from hybridlio.core.errors import ConfigError
from hybridlio.core.tables import counted
from hybridlio.datasets.rosbag.choices import NO_CHOICE, BagTopics

if TYPE_CHECKING:
    from hybridlio.datasets.sequence import Sequence
    from hybridlio.evaluation.report_data import Findings
    from hybridlio.odometry.config import Config
    from hybridlio.odometry.odometry import Odometry
    from hybridlio.runs.run import Run
    from hybridlio.viewing.rerun_live import LiveView

_SCANS_LISTED = 20  # fits on two lines of a terminal


@guarded
@common.with_topic_options
def odometry(
    data: common.Data,
    sequence: common.SequenceName = None,
    reader: common.ReaderName = None,
    raw_root: common.RawRoot = None,
    initial_pose: common.InitialPoseName = None,
    residual: common.ResidualName = None,
    backend: common.BackendName = None,
    config: common.ConfigFile = None,
    frames: common.Frames = None,
    start: common.Start = None,
    n_scans: common.ScanCount = None,
    every: common.Every = 1,
    vertical_angle: common.VerticalAngle = None,
    rate: common.Rate = None,
    check: common.Check = True,
    view: Annotated[
        bool, typer.Option("--view", "--visualize", help="Show the run in the Rerun viewer while it goes.")
    ] = False,
    save: Annotated[
        Path | None,
        typer.Option("--save", metavar="FILE.rrd", help="Write what the viewer would show to a file for it."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", metavar="RUN", help="The run folder; default runs/<sequence>-<date-time>."),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing run in -o.")] = False,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the run in -o that was killed, interrupted or out of space.")
    ] = False,
    topics: BagTopics = NO_CHOICE,
    _verbosity: common.Verbose = 0,
) -> None:
    """Estimate the trajectory of a recording; write poses, covariances, graph, metrics and report to a run folder.

    Without -o, runs/latest links to the newest run. Ctrl-C stops the run and writes what is estimated by then. The
    estimates are kept on the disk as the run goes: --resume goes on after a kill.
    """
    from hybridlio.odometry.odometry import Odometry
    from hybridlio.runs.new_folder import check_run_folder, new_run_folder
    from hybridlio.runs.run import adapt_config
    from hybridlio.runs.whole_folder import partial_folder

    shown = _shown(view, save, data, overwrite)
    if resume and (out is None or overwrite):
        raise ConfigError("--resume needs -o, the folder of the run that is to go on, and no --overwrite")
    chosen = common.load_settings(config, initial_pose=initial_pose, residual=residual, backend=backend)
    estimator = Odometry(config=chosen)  # report unknown names before the recording is opened
    frames = common.range_of(frames, start, n_scans, every)
    check_run_folder(out, overwrite, data, resume=resume)
    recording = common.open_data(data, sequence, reader, raw_root, frames, vertical_angle, topics, rate).every(every)
    adapted = adapt_config(recording, chosen, is_explicit=initial_pose is not None or config is not None)
    if adapted != chosen:
        chosen, estimator = adapted, Odometry(config=adapted)
    recording = common.check_data(recording, check)
    with new_run_folder(recording.name, out, overwrite, data, resume=resume) as folder:
        run = _run(partial_folder(folder), recording, chosen, estimator, resume, shown)
        _finish(folder, run, chosen, is_latest=out is None)


@dataclass(frozen=True)
class _Shown:
    """Where a run is shown while it goes: in a file, or in a viewer."""

    save: Path | None


def _shown(view: bool, save: Path | None, data: Path, overwrite: bool) -> _Shown | None:
    """Return where to show the run, or None; check that it can be shown there."""
    if not view and save is None:
        return None
    if view and save is not None:
        raise ConfigError("--view opens the viewer, --save writes a file for it; give one of them")
    from hybridlio.datasets.protection import check_new_file
    from hybridlio.viewing.rerun_stream import check_target

    check_target(save)
    if save is not None:
        check_new_file(save, overwrite, data)
    return _Shown(save)


def _run(
    part: Path, recording: Sequence, config: Config, estimator: Odometry, resume: bool, shown: _Shown | None
) -> Run:
    """Run the odometry, or go on with a run, and keep its estimates in the hidden folder ``part``."""
    from hybridlio.runs.run import Run, finish_run
    from hybridlio.runs.unfinished.keeper import Keeper
    from hybridlio.runs.unfinished.kept import resume_run

    run, length = resume_run(part, recording, config, estimator) if resume else (Run(recording, estimator), 0)
    if resume:
        print_message(f"resumed after {run.done} of {len(recording)} scans", "none")
    with _watcher(run, shown) as watcher, progress("odometry") as report, Keeper(part, run, config, length) as keeper:
        return finish_run(run, report, keeper, watcher)


@contextmanager
def _watcher(run: Run, shown: _Shown | None) -> Iterator[LiveView | None]:
    """Show a run within the block."""
    if shown is None:
        yield None
        return
    from hybridlio.viewing.rerun_live import LiveView
    from hybridlio.viewing.rerun_stream import rerun_stream

    with rerun_stream(run.sequence.name, shown.save) as stream:
        view = LiveView(stream, run)
        yield view
        view.finish()


def _finish(folder: Path, run: Run, config: Config, is_latest: bool) -> None:
    """Write the run and print its result; exit with an error code where it was stopped."""
    from hybridlio.runs.new_folder import link_latest
    from hybridlio.runs.whole_folder import discard_journal, partial_folder
    from hybridlio.runs.write import write_run

    if run.stopped is not None and len(run.estimates) < 2:  # the first pose is the origin, so nothing is estimated
        discard_journal(partial_folder(folder))
        raise run.stopped
    if isinstance(run.stopped, KeyboardInterrupt):
        print_message("interrupted: writing the estimates so far; interrupt again to write them later", "yellow")
    try:
        findings = write_run(folder, run, config)
    except BaseException:
        print_message(f"the estimates of {run.done} scans are kept; --resume -o {folder} goes on from there", "yellow")
        raise
    if is_latest:
        link_latest(folder)
    _print_result(folder, run, findings)
    if run.stopped is None:
        return
    print_message(
        f"wrote {run.done} of {len(run.sequence)} scans to {folder}; the same command with --resume -o {folder} "
        "estimates the others",
        "yellow",
    )
    if isinstance(run.stopped, KeyboardInterrupt):
        raise typer.Exit(common.INTERRUPTED)
    raise PartialResultError from run.stopped


def _print_result(folder: Path, run: Run, findings: Findings) -> None:
    from hybridlio.evaluation.metrics_table import metrics_table
    from hybridlio.runs.folder import POSES, REPORT
    from hybridlio.runs.write import forward_speed_length_m, imu_conflicts, imu_path_length_m, ms_per_scan

    median_ms = ms_per_scan(run).get("total")
    speed = "" if median_ms is None else f", {median_ms:.0f} ms per scan without reading (median)"
    length = f"{run.trajectory.length_m:.2f} m"
    print_result(f"{run.sequence.name}: {counted(run.done, 'scan')}, {length} in {run.seconds:.1f} s{speed}")
    if (driven := forward_speed_length_m(run)) is not None:
        print_result(f"path length of the IMU: estimate {imu_path_length_m(run):.2f} m, forward speed {driven:.2f} m")
    if run.bridged:
        listed = ", ".join(map(str, run.bridged[:_SCANS_LISTED]))
        more = ", …" if len(run.bridged) > _SCANS_LISTED else ""
        print_result(f"{counted(len(run.bridged), 'scan')} bridged by the initial pose: {listed}{more}")
    for line in imu_conflicts(run):
        print_result(line)
    for warning in (warning for e in findings.evaluations.values() for warning in e.warnings):
        print_warning(warning)
    if findings.evaluations:
        print_table(metrics_table(findings.evaluations))
    print_result(f"poses   {folder / POSES}")
    print_result(f"report  {folder / REPORT}")
