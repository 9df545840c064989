"""``hybridlio smooth``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from hybridlio.commands.common import Verbose, guarded, split_names
from hybridlio.commands.shared import completion
from hybridlio.commands.shared.gps_options import Antenna, MaxShift, Outages, gps_options
from hybridlio.commands.shared.odometry_options import (
    CalibrationFile,
    ImuFile,
    Poses,
    Reference,
    Sideways,
    StampsFile,
    Wheels,
)
from hybridlio.commands.terminal import print_message, print_result, print_table, print_warning, progress
from hybridlio.core.errors import ConfigError, EstimationError

if TYPE_CHECKING:
    from hybridlio.evaluation.report_data import Findings
    from hybridlio.record.inputs import OdometryInputs
    from hybridlio.record.record import Record
    from hybridlio.record.wheel_speeds import WheelSpeeds
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


RobustMethod = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        autocompletion=completion.robust_method,
        help="How to reject wrong loops and fixes: gnc, huber, cauchy, geman-mcclure, dcs.",
    ),
]
UseGps = Annotated[
    bool,
    typer.Option(
        "--gps",
        help="Use the run's GPS fixes, or with --poses those of the CSV file that follows; their frame and clock "
        "offset are estimated.",
    ),
]
UseLoops = Annotated[
    bool, typer.Option("--loops", help="Detect places that the run visits again, and close the loops.")
]


@guarded
def smooth(
    run: Annotated[
        Path | None,
        typer.Argument(
            metavar="[RUN]",
            help="A run folder written by `hybridlio odometry`. With --poses and --gps: the file of fixes.",
            show_default=False,
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", metavar="DIR", help="The folder to write to; default RUN/smoothed.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing run in -o.")] = False,
    loops: UseLoops = False,
    gps: UseGps = False,
    antenna: Antenna = None,
    outage: Outages = None,
    max_shift: MaxShift = None,
    calibrate: Calibrate = "",
    robust: RobustMethod = None,
    poses: Poses = None,
    stamps: StampsFile = None,
    imu: ImuFile = None,
    calibration: CalibrationFile = None,
    reference: Reference = None,
    wheels: Wheels = None,
    sideways: Sideways = None,
    _verbosity: Verbose = 0,
) -> None:
    """Optimise all poses of a run together; write the smoothed trajectory and its report.

    Of a run that was killed, or still goes, the scans so far are smoothed; the default folder is then RUN-smoothed.
    With --poses the result of another odometry is smoothed, with an IMU, GPS or both.
    """
    from hybridlio.runs.new_folder import new_run_folder
    from hybridlio.runs.write import write_smoothed

    if not gps and not (antenna is None and outage is None and max_shift is None):
        raise ConfigError("--antenna, --outage and --max-shift apply to GPS fixes; give --gps too")
    speeds = _wheel_speeds(wheels, sideways)
    if poses is not None:
        stored, record = _other(poses, (stamps, imu, calibration, reference), run, gps, out)
        folder, is_default = out or Path(), False
    elif run is None:
        raise ConfigError("give a run folder, or poses of another odometry with --poses")
    else:
        folder, is_default = out or _default_folder(run), out is None
        stored, record = _stored(run, loops, folder, any((stamps, imu, calibration, reference)))
    options = gps and gps_options(antenna, max_shift, outage, int(record.online.stamps_ns[0]))
    with new_run_folder(stored.metrics["sequence"], folder, overwrite or is_default):
        smoothed = _smooth(record, loops, options, robust, split_names(calibrate), speeds)
        if smoothed.verdict.refused:
            raise EstimationError("; ".join(smoothed.verdict.doubts))
        findings = write_smoothed(folder, stored, record, smoothed)
    _print_result(folder, stored.metrics["sequence"], smoothed, findings)


def _wheel_speeds(path: Path | None, sideways: float | None) -> WheelSpeeds | None:
    from hybridlio.record.wheel_speeds import read_wheel_speeds

    if path is None:
        if sideways is not None:
            raise ConfigError("--sideways says how much the wheels of --wheels slip; give --wheels too")
        return None
    return replace(read_wheel_speeds(path), sideways_sigma_m_s=sideways)


def _other(
    poses: Path, files: tuple[Path | None, ...], fixes: Path | None, gps: bool, out: Path | None
) -> tuple[StoredRun, Record]:
    """Return the poses of another odometry as a run, and their record."""
    from hybridlio.core.trajectory import is_tum_file, read_kitti
    from hybridlio.record.inputs import poses_of, record_of
    from hybridlio.runs.results.other_odometry import as_stored_run

    if out is None:
        raise ConfigError("with --poses give the folder to write to with -o")
    if gps != (fixes is not None):
        raise ConfigError("with --poses: --gps FILE names the CSV file of fixes, and nothing else follows")
    stamps, imu, calibration, reference = files
    given = {"stamps": stamps, "imu": imu, "calibration": calibration, "fixes": fixes}
    record = record_of(poses, cast("OdometryInputs", {name: path for name, path in given.items() if path is not None}))
    truth = None
    if reference is not None:
        T = record.calibration.T_camera_lidar
        as_poses = is_tum_file(reference) or reference.suffix == ".csv"
        truth = poses_of(reference) if as_poses else read_kitti(reference, record.online.stamps_ns, T)
    return as_stored_run(poses, record, truth), record


def _default_folder(run: Path) -> Path:
    from hybridlio.runs.folder import SMOOTHED

    return run.with_name(f"{run.name}-{SMOOTHED}") if _is_unfinished(run) else run / SMOOTHED


def _is_unfinished(run: Path) -> bool:
    from hybridlio.runs.folder import is_run_folder
    from hybridlio.runs.whole_folder import JOURNAL, partial_folder

    return (partial_folder(run) / JOURNAL).is_file() and not is_run_folder(run)


def _stored(run: Path, loops: bool, folder: Path, has_files: bool) -> tuple[StoredRun, Record]:
    if has_files:
        raise ConfigError("--stamps, --imu, --calibration and --reference belong to --poses; a run has its own")
    if folder.resolve() == run.resolve():
        raise ConfigError(f"{folder} is the run itself; choose another folder with -o")
    return _unfinished(run) if _is_unfinished(run) else _finished(run, loops)


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
    if (driven := smoothed.found.get("wheels")) is not None:
        print_result(f"wheels: {driven.summary()}")
    if (calibrated := smoothed.found.get("calibration")) is not None:
        print_result(f"calibration: {calibrated.summary()}")
        for doubt in calibrated.doubts:
            print_warning(doubt)
    print_result(smoothed.verdict.summary())
    for doubt in smoothed.verdict.doubts:
        print_warning(doubt)
    if not smoothed.converged:
        print_warning("the optimiser stopped at its iteration limit, before it converged")
    if findings.evaluations:
        print_table(metrics_table(findings.evaluations))
    print_result(f"poses   {folder / POSES}")
    print_result(f"report  {folder / REPORT}")


def _smooth(
    record: Record,
    loops: bool,
    gps: bool | GpsOptions,
    robust: str | None,
    calibrate: tuple[str, ...],
    wheels: WheelSpeeds | None,
) -> Smoothed:
    from hybridlio.graph.run.smooth import smooth as optimise

    further: OdometryInputs = {} if wheels is None else {"wheels": wheels}
    with progress("smoothing", "poses", {"loops": "keyframes", "optimising": "rounds"}) as report:
        return optimise(record, report, loops=loops, gps=gps, robust=robust, calibrate=calibrate, **further)
