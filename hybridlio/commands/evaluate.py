"""``hybridlio evaluate``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hybridlio.commands.common import Verbose, guarded
from hybridlio.commands.terminal import complain, say, say_table
from hybridlio.core.errors import ConfigError, DataError

if TYPE_CHECKING:
    from hybridlio.core.trajectory import Trajectory
    from hybridlio.evaluation.evaluate import Steps


@guarded
def evaluate(
    estimate: Annotated[
        Path, typer.Argument(metavar="EST", help="A run folder, or a TUM or KITTI file.", show_default=False)
    ],
    reference: Annotated[
        Path | None,
        typer.Option(
            metavar="GT",
            help="A TUM or KITTI file, a run folder, or a recording that has a reference; "
            "without it the one that came with the run's recording.",
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print every figure as JSON.")] = False,
    lengths: Annotated[
        str | None, typer.Option(metavar="10,20,…", help="Drift over segments of these lengths (metres) too.")
    ] = None,
    _verbose: Verbose = 0,
) -> None:
    """Judge a trajectory: KITTI's drift, ATE, RPE and, for a run folder, whether its covariances are true."""
    from hybridlio.evaluation.evaluate import evaluate as judge
    from hybridlio.evaluation.figures import evaluation_table

    true, estimated, steps = _load(estimate, reference)
    result = judge(true, estimated, lengths_m=_numbers(lengths), steps=steps)
    if as_json:
        say(json.dumps(result.to_json_dict(), indent=2, ensure_ascii=False))
    else:
        say_table(evaluation_table({estimate.name or str(estimate): result}))
    for warning in result.warnings:
        complain(f"warning: {warning}", "yellow")


def _load(estimate: Path, reference: Path | None) -> tuple[Trajectory, Trajectory, Steps | None]:
    """Reference, estimate, and the steps behind the estimate where it is a run folder."""
    import numpy as np

    from hybridlio.core.trajectory_files import read_pair, read_trajectory
    from hybridlio.runs.folder import read_run

    if not estimate.is_dir():
        if reference is None:
            raise ConfigError(f"give --reference: {estimate} is a file and says nothing of the truth")
        if reference.is_file():
            return (*read_pair(reference, estimate), None)
        true = _reference(reference)
        return true, read_trajectory(estimate, true.stamps_ns), None
    run = read_run(estimate)
    if reference is None and run.reference is None:
        raise DataError(f"{estimate}: the run's recording had no reference; give one with --reference")
    if reference is None:
        return run.reference, run.trajectory, run.steps  # type: ignore[return-value]
    if reference.is_dir():
        return _reference(reference), run.trajectory, run.steps
    stamps = np.concatenate([run.stamps_before, run.trajectory.stamps_ns])
    return read_trajectory(reference, stamps, run.T_camera_lidar), run.trajectory, run.steps


def _reference(folder: Path) -> Trajectory:
    """The poses of a run, or the reference of a recording."""
    from hybridlio.datasets.registry import open_sequence
    from hybridlio.runs.folder import is_run_folder, read_run

    if is_run_folder(folder):
        return read_run(folder).trajectory
    reference = open_sequence(folder).reference
    if reference is None:
        raise DataError(f"{folder}: this recording has no reference")
    return reference


def _numbers(text: str | None) -> tuple[float, ...] | None:
    if text is None:
        return None
    try:
        lengths = tuple(float(word) for word in text.split(","))
    except ValueError:
        lengths = ()
    if not lengths or min(lengths) <= 0:
        raise ConfigError(f"--lengths {text!r}: give lengths in metres, such as 10,20,50")
    return lengths
