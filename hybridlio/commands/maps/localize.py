"""``hybridlio localize``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hybridlio.commands import common
from hybridlio.commands.common import PartialResultError, guarded
from hybridlio.commands.terminal import print_result, print_warning, progress
from hybridlio.core.errors import ConfigError
from hybridlio.core.tables import counted
from hybridlio.datasets.rosbag.choices import NO_CHOICE, BagTopics

if TYPE_CHECKING:
    from hybridlio.localization.result import Localization


Map = Annotated[
    Path,
    typer.Option(
        "--map", metavar="MAP", help="A run folder, or a map: .ply, .pcd, .las, .laz or .npz.", show_default=False
    ),
]
Start = Annotated[
    str | None,
    typer.Option(
        "--start",
        metavar="X,Y,YAW",
        help="Where the first scan is in the map, about: metres, degrees. By default the place is recognised.",
    ),
]


@guarded
@common.with_topic_options
def localize(
    data: common.Data,
    map_: Map,
    start: Start = None,
    sequence: common.SequenceName = None,
    reader: common.ReaderName = None,
    raw_root: common.RawRoot = None,
    initial_pose: common.InitialPoseName = None,
    residual: common.ResidualName = None,
    backend: common.BackendName = None,
    config: common.ConfigFile = None,
    frames: common.Frames = None,
    n_scans: common.ScanCount = None,
    every: common.Every = 1,
    vertical_angle: common.VerticalAngle = None,
    rate: common.Rate = None,
    check: common.Check = True,
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", metavar="OUT", help="The folder; default runs/<sequence>-<date-time>."),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing run in -o.")] = False,
    topics: BagTopics = NO_CHOICE,
    _verbosity: common.Verbose = 0,
) -> None:
    """Find a recording's place in a map and follow it there; write its poses in the map's frame, with covariances.

    Where the map ends or its places have changed, odometry goes on alone until the map holds again; localization.csv
    says for each scan whether the map held its pose. Exits with an error where the place is not found.
    """
    from hybridlio.localization.localize import localize as localize_in
    from hybridlio.localization.open_map import open_prior_map
    from hybridlio.localization.write import write_localization
    from hybridlio.mapping.map_projection import crs_of_file
    from hybridlio.runs.new_folder import check_run_folder, new_run_folder

    place = None if start is None else _start(start)
    chosen = common.load_settings(config, initial_pose=initial_pose, residual=residual, backend=backend)
    frames = common.range_of(frames, None, n_scans, every)
    check_run_folder(out, overwrite, data)
    recording = common.open_data(data, sequence, reader, raw_root, frames, vertical_angle, topics, rate).every(every)
    prior, crs = open_prior_map(map_), crs_of_file(map_)
    recording = common.check_data(recording, check)
    with new_run_folder(recording.name, out, overwrite, data) as folder:
        with progress("localising") as report:
            found = localize_in(recording, prior, place, chosen, progress=report)
        write_localization(folder, found, map_, crs)
    _print_result(folder, found)
    if isinstance(found.run.stopped, KeyboardInterrupt):
        raise typer.Exit(common.INTERRUPTED)
    if found.run.stopped is not None:
        raise PartialResultError from found.run.stopped


def _start(text: str) -> tuple[float, float, float]:
    """Return x, y (metres) and yaw (radians) of ``X,Y,YAW`` in metres and degrees."""
    import math

    try:
        x, y, yaw_deg = (float(part) for part in text.split(","))
    except ValueError:
        raise ConfigError(f"--start {text!r}: expected X,Y,YAW in metres and degrees, such as 12.5,-3,90") from None
    return x, y, math.radians(yaw_deg)


def _print_result(folder: Path, found: Localization) -> None:
    from hybridlio.runs.folder import LOCALIZATION, POSES

    run, held = found.run, int(found.held.sum())
    print_result(f"{run.sequence.name}: found in the map at scan {run.skipped + found.found}")
    print_result(f"{counted(held, 'pose')} of {len(found.held)} held by the map")
    if not found.held[-1]:
        print_warning("the map does not hold the last pose; its covariance says how far odometry may be off")
    print_result(f"poses   {folder / POSES}")
    print_result(f"table   {folder / LOCALIZATION}")
