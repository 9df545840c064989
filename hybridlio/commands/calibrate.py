"""``hybridlio calibrate``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hybridlio.commands import common
from hybridlio.commands.common import guarded
from hybridlio.commands.shared import completion
from hybridlio.commands.terminal import print_result, print_warning, progress
from hybridlio.datasets.rosbag.choices import NO_CHOICE, BagTopics

if TYPE_CHECKING:
    from hybridlio.smoothing.calibration import Calibrated


@guarded
@common.with_topic_options
def calibrate(
    data: common.Data,
    out: Annotated[
        Path, typer.Option("-o", "--out", metavar="FILE", help="The calibration.yaml to write.", show_default=False)
    ],
    parameters: Annotated[
        str,
        typer.Option(
            "--calibrate",
            metavar="A,B,…",
            autocompletion=completion.calibrated,
            help="What to find: extrinsics, time_offset, imu_scale, lever_arm, gps_clock.",
        ),
    ] = "extrinsics,time_offset",
    overwrite: common.Overwrite = False,
    sequence: common.SequenceName = None,
    reader: common.ReaderName = None,
    raw_root: common.RawRoot = None,
    frames: common.Frames = None,
    rate: common.Rate = None,
    config: common.ConfigFile = None,
    topics: BagTopics = NO_CHOICE,
    _verbosity: common.Verbose = 0,
) -> None:
    """Find the extrinsics and clocks of a recording's sensors, with standard deviations.

    A minute in which the sensors turn about every axis is enough. What the motion does not determine is named, and
    stays as stated.
    """
    from hybridlio.datasets.protection import check_new_file
    from hybridlio.runs.calibrate import calibrate as find

    check_new_file(out, overwrite, data)
    recording = common.open_data(data, sequence, reader, raw_root, frames, None, topics, rate)
    with progress("calibration") as report:
        found = find(recording, common.split_names(parameters), config=common.load_settings(config), progress=report)
    found.save(out, _own_file(data))
    _print_result(found, out)


def _own_file(data: Path) -> dict[str, Any]:
    """Return the content of the recording's own calibration.yaml, if it has one."""
    from hybridlio.core.files import read_yaml

    path = data / "calibration.yaml"
    return dict(read_yaml(path)) if path.is_file() else {}


def _print_result(found: Calibrated, out: Path) -> None:
    for parameter in found.parameters:
        print_result(str(parameter))
    for doubt in found.doubts:
        print_warning(doubt)
    print_result(f"calibration  {out}")
