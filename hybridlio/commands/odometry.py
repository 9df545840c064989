"""``hybridlio odometry``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hybridlio.commands import common
from hybridlio.commands.common import FAILED, guarded
from hybridlio.commands.terminal import complain, progress, say, say_table
from hybridlio.core.tables import counted

if TYPE_CHECKING:
    from hybridlio.evaluation.report_data import Findings
    from hybridlio.odometry.config import Config
    from hybridlio.runs.run import Run


@guarded
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
    vertical_angle: common.VerticalAngle = None,
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", metavar="RUN", help="The run folder; by default runs/<sequence>-<date-time>."),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the run that is in -o.")] = False,
    _verbose: common.Verbose = 0,
) -> None:
    """Estimate a recording's trajectory and leave it, with covariances, graph, metrics and report, in a run folder.

    Without -o, runs/latest is a link to the newest. Ctrl-C keeps what was estimated so far.
    """
    from hybridlio.odometry.odometry import Odometry
    from hybridlio.runs.folder import new_run_folder
    from hybridlio.runs.run import run_odometry, suited_to

    chosen = common.settings(config, initial_pose=initial_pose, residual=residual, backend=backend)
    estimator = Odometry(config=chosen)  # wrong names fail before the recording is opened
    recording = common.open_data(data, sequence, reader, raw_root, frames, vertical_angle)
    suited = suited_to(recording, chosen, as_asked=initial_pose is not None or config is not None)
    if suited != chosen:
        chosen, estimator = suited, Odometry(config=suited)
    folder = new_run_folder(recording.name, out, overwrite)
    with progress("odometry") as tick:
        run = run_odometry(recording, estimator, lambda done, total, metres: tick(done, total, f"{metres:.1f} m"))
    _finish(folder, run, chosen, is_latest=out is None)


def _finish(folder: Path, run: Run, config: Config, is_latest: bool) -> None:
    """Write the run and say what came of it; an interrupted or failed one ends with its exit code."""
    from hybridlio.runs.folder import point_latest_at
    from hybridlio.runs.write import write_run

    if run.stopped is not None and len(run.estimates) < 2:  # the first pose is the origin: nothing is known yet
        _remove_if_empty(folder)
        common.fail(run.stopped)
    if isinstance(run.stopped, KeyboardInterrupt):
        complain("interrupted: writing what was estimated so far (again to give it up)", "yellow")
    findings = write_run(folder, run, config)
    if is_latest:
        point_latest_at(folder)
    _say_result(folder, run, findings)
    if run.stopped is None:
        return
    complain(f"kept {run.done} of {len(run.sequence)} scans in {folder}", "yellow")
    if isinstance(run.stopped, KeyboardInterrupt):
        raise typer.Exit(common.INTERRUPTED)
    common.fail(run.stopped, FAILED)


def _say_result(folder: Path, run: Run, findings: Findings) -> None:
    from hybridlio.evaluation.figures import evaluation_table
    from hybridlio.runs.folder import POSES, REPORT
    from hybridlio.runs.write import disagreements, forward_speed_length_m, imu_path_length_m, ms_per_scan

    metres, ms = run.trajectory.length_m, ms_per_scan(run).get("total")
    speed = "" if ms is None else f", {ms:.0f} ms a scan without reading (median)"
    say(f"{run.sequence.name}: {counted(run.done, 'scan')}, {metres:.2f} m in {run.seconds:.1f} s{speed}")
    if (driven := forward_speed_length_m(run)) is not None:
        say(
            f"by its own forward speed the vehicle drove {driven:.2f} m, by the estimate {imu_path_length_m(run):.2f} m"
        )
    if run.bridged:
        say(f"bridged scans: {', '.join(map(str, run.bridged[:20]))}{' …' if len(run.bridged) > 20 else ''}")
    for line in disagreements(run):
        say(line)
    for warning in (warning for e in findings.evaluations.values() for warning in e.warnings):
        complain(f"warning: {warning}", "yellow")
    if findings.evaluations:
        say_table(evaluation_table(findings.evaluations))
    say(f"poses   {folder / POSES}")
    say(f"report  {folder / REPORT}")


def _remove_if_empty(folder: Path) -> None:
    if not any(folder.iterdir()):
        folder.rmdir()
