"""``hybridlio compare``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hybridlio.commands import common
from hybridlio.commands.common import guarded
from hybridlio.commands.terminal import complain, progress, say, say_table
from hybridlio.core.errors import ConfigError
from hybridlio.odometry.registry import BACKENDS, INITIAL_POSE_SOURCES, RESIDUAL_SOURCES

if TYPE_CHECKING:
    from hybridlio.runs.compare import Comparison


def _several(names: tuple[str, ...]) -> str:
    return f"Some of {', '.join(names)}, with commas between; `all` for each."


@guarded
def compare(
    data: common.Data,
    sequence: common.SequenceName = None,
    reader: common.ReaderName = None,
    raw_root: common.RawRoot = None,
    initial_pose: Annotated[
        str, typer.Option("--initial-pose", metavar="A,B,…", help=_several(tuple(INITIAL_POSE_SOURCES)))
    ] = "all",
    residual: Annotated[
        str | None, typer.Option(metavar="A,B,…", help=_several(tuple(RESIDUAL_SOURCES)), show_default=False)
    ] = None,
    backend: Annotated[
        str | None, typer.Option(metavar="A,B,…", help=_several(tuple(BACKENDS)), show_default=False)
    ] = None,
    config: common.ConfigFile = None,
    frames: common.Frames = None,
    vertical_angle: common.VerticalAngle = None,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", metavar="DIR", help="Write compare.json and compare.md there.")
    ] = None,
    _verbose: common.Verbose = 0,
) -> None:
    """Run every combination of sources over the same scans, and show them side by side."""
    from hybridlio.core.files import make_folder
    from hybridlio.runs.compare import combinations, table, write_comparison
    from hybridlio.runs.compare import compare as run_all

    settings = common.settings(config)
    configs = combinations(
        _names(initial_pose, tuple(INITIAL_POSE_SOURCES), "--initial-pose"),
        _names(residual or settings.residual, tuple(RESIDUAL_SOURCES), "--residual"),
        _names(backend or settings.backend, tuple(BACKENDS), "--backend"),
        settings,
    )
    recording = common.open_data(data, sequence, reader, raw_root, frames, vertical_angle)
    if out is not None:
        make_folder(out)  # before the work
    with progress("comparing") as tick:
        comparison = run_all(recording, configs, lambda name, done, total: tick(done, total, name))
    say_table(table(comparison))
    if out is not None:
        write_comparison(out, comparison)
        say(f"written to {out / 'compare.md'} and {out / 'compare.json'}")
    _finish(comparison)


def _finish(comparison: Comparison) -> None:
    """Say why runs ended early, a reason that they share once, and exit with the code that belongs to it."""
    if comparison.stopped is not None:
        common.fail(comparison.stopped)
    failed: dict[tuple[str, int], list[str]] = {}
    for row in comparison.rows:
        if row.error:
            failed.setdefault((row.error, row.scans), []).append(f"{row.initial_pose} + {row.residual}")
    for (error, scans), names in failed.items():
        complain(f"error: {', '.join(names)} ended after {scans} scans: {error}")
    if failed:
        raise typer.Exit(common.FAILED)


def _names(text: str, known: tuple[str, ...], option: str) -> tuple[str, ...]:
    names = tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
    if names == ("all",):
        return known
    unknown = [name for name in names if name not in known]
    if unknown or not names:
        what = f"unknown {unknown[0]!r}" if unknown else "no name"
        raise ConfigError(f"{option} {text!r}: {what}; give some of {', '.join(known)}, with commas between, or all")
    return names
