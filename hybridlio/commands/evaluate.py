"""``hybridlio evaluate``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hybridlio.commands.common import Verbose, guarded
from hybridlio.commands.terminal import print_result, print_table, print_warning
from hybridlio.core.errors import ConfigError, DataError

if TYPE_CHECKING:
    from hybridlio.core.trajectory import Trajectory
    from hybridlio.evaluation.evaluate import Steps


@guarded
def evaluate(
    estimate: Annotated[
        Path,
        typer.Argument(metavar="EST", help="The estimate: a run folder, or a TUM or KITTI file.", show_default=False),
    ],
    reference: Annotated[
        Path | None,
        typer.Option(
            metavar="GT",
            help="The ground truth: a TUM or KITTI file, a run folder, or a recording with a reference. "
            "Default: the reference stored in the run folder.",
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print all metrics as JSON.")] = False,
    lengths: Annotated[
        str | None,
        typer.Option(metavar="10,20,…", help="Also compute the drift over segments of these lengths in metres."),
    ] = None,
    _verbosity: Verbose = 0,
) -> None:
    """Compare a trajectory with ground truth: KITTI drift, ATE, RPE and, for a run folder, covariance consistency."""
    from hybridlio.evaluation.evaluate import evaluate as evaluate_trajectory
    from hybridlio.evaluation.metrics_table import metrics_table

    estimated, true, steps = load_pair(estimate, reference)
    result = evaluate_trajectory(estimated, true, lengths_m=_parse_lengths(lengths), steps=steps)
    if as_json:
        print_result(json.dumps(result.to_json_dict(), indent=2, ensure_ascii=False))
    else:
        print_table(metrics_table({estimate.name or str(estimate): result}))
    for warning in result.warnings:
        print_warning(warning)


def load_pair(estimate: Path, reference: Path | None) -> tuple[Trajectory, Trajectory, Steps | None]:
    """Return the estimate, the reference and, for a run folder, the estimate's steps."""
    import numpy as np

    from hybridlio.core.trajectory import read_pair, read_trajectory
    from hybridlio.runs.folder import read_run

    if not estimate.is_dir():
        if reference is None:
            raise ConfigError(f"{estimate} is a trajectory file without ground truth; give --reference")
        if reference.is_file():
            return (*read_pair(estimate, reference), None)
        true = _load_reference(reference)
        return read_trajectory(estimate, true.stamps_ns), true, None
    run = read_run(estimate)
    if reference is None and run.reference is None:
        raise DataError(f"{estimate}: the recording of this run has no reference; give one with --reference")
    if reference is None:
        return run.trajectory, run.reference, run.steps  # type: ignore[return-value]
    if reference.is_dir():
        return run.trajectory, _load_reference(reference), run.steps
    stamps = np.concatenate([run.stamps_before, run.trajectory.stamps_ns])
    return run.trajectory, read_trajectory(reference, stamps, run.T_camera_lidar), run.steps


def _load_reference(folder: Path) -> Trajectory:
    """Return the estimate of a run folder, or the reference of a recording."""
    from hybridlio.datasets.registry import open_sequence
    from hybridlio.runs.folder import is_run_folder, read_run

    if is_run_folder(folder):
        return read_run(folder).trajectory
    reference = open_sequence(folder).reference
    if reference is None:
        raise DataError(f"{folder}: this recording has no reference; give another one with --reference")
    return reference


def _parse_lengths(text: str | None) -> tuple[float, ...] | None:
    if text is None:
        return None
    try:
        lengths = tuple(float(word) for word in text.split(","))
    except ValueError:
        lengths = ()
    if not lengths or min(lengths) <= 0:
        raise ConfigError(f"--lengths {text!r}: give positive lengths in metres, such as 10,20,50")
    return lengths
