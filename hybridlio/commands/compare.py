"""``hybridlio compare``."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hybridlio.commands import common
from hybridlio.commands.common import guarded
from hybridlio.commands.shared import completion
from hybridlio.commands.terminal import print_message, print_result, print_table, progress
from hybridlio.core.errors import ConfigError
from hybridlio.core.tables import counted
from hybridlio.datasets.rosbag.choices import NO_CHOICE, BagTopics
from hybridlio.odometry.registry import BACKENDS, INITIAL_POSE_SOURCES, RESIDUAL_SOURCES

if TYPE_CHECKING:
    from hybridlio.runs.compare import Comparison

_INITIAL_POSES, _RESIDUALS, _BACKENDS = tuple(INITIAL_POSE_SOURCES), tuple(RESIDUAL_SOURCES), tuple(BACKENDS)


def _choice_help(names: tuple[str, ...]) -> str:
    return f"One or more of {', '.join(names)}, separated by commas; or `all`."


@guarded
@common.with_topic_options
def compare(
    data: common.Data,
    sequence: common.SequenceName = None,
    reader: common.ReaderName = None,
    raw_root: common.RawRoot = None,
    initial_pose: Annotated[
        str,
        typer.Option(
            "--initial-pose", metavar="A,B,…", autocompletion=completion.initial_pose, help=_choice_help(_INITIAL_POSES)
        ),
    ] = "all",
    residual: Annotated[
        str | None,
        typer.Option(
            metavar="A,B,…", autocompletion=completion.residual, help=_choice_help(_RESIDUALS), show_default=False
        ),
    ] = None,
    backend: Annotated[
        str | None,
        typer.Option(
            metavar="A,B,…", autocompletion=completion.backend, help=_choice_help(_BACKENDS), show_default=False
        ),
    ] = None,
    config: common.ConfigFile = None,
    frames: common.Frames = None,
    vertical_angle: common.VerticalAngle = None,
    rate: common.Rate = None,
    check: common.Check = True,
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", metavar="DIR", help="Write compare.json and compare.md to this folder."),
    ] = None,
    topics: BagTopics = NO_CHOICE,
    _verbosity: common.Verbose = 0,
) -> None:
    """Run the odometry on the same scans with every combination of sources, and print a table of the results."""
    from hybridlio.runs.compare import combinations, compare_configs, table, write_comparison
    from hybridlio.runs.new_folder import claimed
    from hybridlio.runs.own_files import COMPARISON

    settings = common.load_settings(config)
    configs = combinations(
        _choices(initial_pose, _INITIAL_POSES, "--initial-pose"),
        _choices(residual or settings.residual, _RESIDUALS, "--residual"),
        _choices(backend or settings.backend, _BACKENDS, "--backend"),
        settings,
    )
    recording = common.open_data(data, sequence, reader, raw_root, frames, vertical_angle, topics, rate)
    recording = common.check_data(recording, check)
    with nullcontext() if out is None else claimed(out, COMPARISON, data):  # fails before the runs, not after them
        with progress("comparing") as report:
            comparison = compare_configs(recording, configs, report)
        print_table(table(comparison))
        if out is not None:
            write_comparison(out, comparison)
            print_result(f"wrote {out / 'compare.md'} and {out / 'compare.json'}")
    _finish(comparison)


def _finish(comparison: Comparison) -> None:
    """Print why runs ended early, each shared reason once, and exit with an error code if any did."""
    if comparison.stopped is not None:
        raise comparison.stopped
    failed: dict[tuple[str, int], list[str]] = {}
    for row in comparison.rows:
        if row.error:
            failed.setdefault((row.error, row.scans), []).append(f"{row.initial_pose} + {row.residual}")
    for (error, scans), names in failed.items():
        print_message(f"error: {', '.join(names)} ended after {counted(scans, 'scan')}: {error}")
    if failed:
        raise typer.Exit(common.FAILED)


def _choices(text: str, known: tuple[str, ...], option: str) -> tuple[str, ...]:
    names = tuple(dict.fromkeys(common.split_names(text)))
    if names == ("all",):
        return known
    unknown = [name for name in names if name not in known]
    if unknown or not names:
        problem = f"unknown name {unknown[0]!r}" if unknown else "no name given"
        raise ConfigError(
            f"{option} {text!r}: {problem}; choose from {', '.join(known)}, separated by commas, or give all"
        )
    return names
