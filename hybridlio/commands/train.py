"""``hybridlio train``."""

from __future__ import annotations

from contextlib import nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hybridlio.commands import common
from hybridlio.commands.common import INTERRUPTED, guarded
from hybridlio.commands.shared import completion
from hybridlio.commands.shared.training_process import Device, first_process_progress, is_first_process
from hybridlio.commands.terminal import print_message, print_result
from hybridlio.core.errors import ConfigError
from hybridlio.datasets.rosbag.choices import NO_CHOICE, BagTopics
from hybridlio.odometry.registry import INITIAL_POSE_SOURCES

if TYPE_CHECKING:
    from hybridlio.learned.data.pairs import Pairs
    from hybridlio.learned.networks.weights import Weights
    from hybridlio.learned.settings import Recipe
    from hybridlio.learned.training.run_options import RunOptions, TrainingProgress
    from hybridlio.learned.training.validation_result import Validation
    from hybridlio.runs.training.training_data import DataOptions

RecordingsIfAny = Annotated[
    list[Path] | None,
    typer.Argument(metavar="[DATA…]", help="Recordings, folders of recordings, or shards.", show_default=False),
]
Simulate = Annotated[
    int | None,
    typer.Option(
        min=1,
        metavar="N",
        help="Also train on N simulated drives of 22 s, each about half a minute of a core and 45 MB; another "
        "twentieth validates. They are kept in --cache.",
    ),
]
Lidar = Annotated[
    str,
    typer.Option(
        metavar="NAME",
        autocompletion=completion.lidar_model,
        help="The lidar of simulated drives: hdl-64e, 32-beam, 16-beam.",
    ),
]
Preset = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        autocompletion=completion.preset,
        help="default, paper, cho, nubert or another row of the paper's tables; default unless --init-from is given.",
    ),
]
RecipeFile = Annotated[
    Path | None,
    typer.Option("--config", metavar="FILE", help="YAML file that changes the preset's network, loss or optimiser."),
]
InitFrom = Annotated[
    str | None,
    typer.Option("--init-from", metavar="FILE", help="Weights to start from, or `shipped` for those of hybridlio."),
]
InitialPose = Annotated[
    str | None,
    typer.Option(
        "--initial-pose",
        metavar="NAME",
        autocompletion=completion.initial_pose,
        help=f"Source of the network's initial poses: {', '.join(INITIAL_POSE_SOURCES)}.",
    ),
]
Validate = Annotated[
    list[Path] | None,
    typer.Option("--validate", metavar="DATA", help="A recording to validate on during training; may be repeated."),
]
Split = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        autocompletion=completion.split,
        help="Split of KITTI odometry, easy or hard; validates on its test sequences.",
    ),
]
Out = Annotated[
    Path | None, typer.Option("-o", "--out", metavar="DIR", help="The run's folder; default training/<preset>.")
]
Cache = Annotated[Path | None, typer.Option(metavar="DIR", help="The folder for prepared recordings; default: in -o.")]
Epochs = Annotated[int | None, typer.Option(min=1, help="Passes over the data.")]
Steps = Annotated[int | None, typer.Option(min=1, help="Optimiser steps in all; replaces --epochs.")]
Workers = Annotated[
    int | None,
    typer.Option(
        min=0,
        metavar="N",
        help="Processes that read batches; by default one a core up to 8 on a GPU, and a thread (0) on a CPU.",
    ),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Delete an existing run in -o and start again.")]


@guarded
@common.with_topic_options
def train(
    data: RecordingsIfAny = None,
    simulate: Simulate = None,
    lidar: Lidar = "hdl-64e",
    preset: Preset = None,
    config: RecipeFile = None,
    init_from: InitFrom = None,
    initial_pose: InitialPose = None,
    validate: Validate = None,
    split: Split = None,
    sequence: common.SequenceNames = None,
    reader: common.ReaderName = None,
    raw_root: common.RawRoot = None,
    out: Out = None,
    cache: Cache = None,
    epochs: Epochs = None,
    steps: Steps = None,
    device: Device = "auto",
    workers: Workers = None,
    overwrite: Overwrite = False,
    topics: BagTopics = NO_CHOICE,
    _verbosity: common.Verbose = 0,
) -> None:
    """Train the network, or adapt trained weights, without labels. Start it by torchrun to use several processes.

    The same command resumes an interrupted run from its last checkpoint.
    """
    from hybridlio.datasets.protection import check_output
    from hybridlio.learned.networks.devices import pick_device
    from hybridlio.learned.networks.weights import load_weights, weights_path
    from hybridlio.learned.training.run_options import RunOptions
    from hybridlio.runs.new_folder import claimed
    from hybridlio.runs.own_files import TRAINING
    from hybridlio.runs.training.recipes import choose_recipe, for_steps
    from hybridlio.runs.training.training_data import DataOptions, training_pairs

    pick_device(device)
    _check_options(data, simulate, lidar, steps, epochs)
    start = load_weights(weights_path(init_from)) if init_from is not None else None
    recipe = choose_recipe(preset, start.recipe if start else None, config, initial_pose, epochs)
    folder = out or Path("training") / recipe.name
    if cache is not None:
        check_output(cache)
    with claimed(folder, TRAINING) if is_first_process() else nullcontext():
        if is_first_process() and overwrite:
            _clear(folder)
        names = None if sequence is None else common.split_names(sequence)
        options = DataOptions(cache or folder / "shards", initial_pose, names, reader, raw_root, topics)
        data, validate = _with_simulated(data or [], validate, simulate, recipe, options, lidar)
        with first_process_progress("preparing", "scans") as report:
            pairs, tests = training_pairs(data, validate, split, recipe, options, report)
        if steps is not None:
            recipe = for_steps(recipe, steps, len(pairs))
        run_options = RunOptions(None if device == "auto" else device, max_steps=steps, workers=workers)
        _run(recipe, pairs, tests, folder, (init_from, start), run_options)


def _check_options(
    data: list[Path] | None, simulate: int | None, lidar: str, steps: int | None, epochs: int | None
) -> None:
    if not data and simulate is None:
        raise ConfigError("nothing to train on: give recordings, or --simulate N for simulated drives")
    from hybridlio.core.lidar_models import LIDAR_MODELS

    if lidar not in LIDAR_MODELS:
        raise ConfigError(f"--lidar: unknown lidar {lidar!r}; choose one of {', '.join(LIDAR_MODELS)}")
    if steps is not None and epochs is not None:
        raise ConfigError("--steps and --epochs both set the length of the training; give one of them")


def _with_simulated(
    data: list[Path],
    validate: list[Path] | None,
    count: int | None,
    recipe: Recipe,
    options: DataOptions,
    lidar: str,
) -> tuple[list[Path], list[Path] | None]:
    """Return the data to train and validate on with the shards of simulated drives among them."""
    from hybridlio.runs.training.simulated_data import simulated_drives

    if count is None:
        return data, validate
    with first_process_progress("simulating", "scans") as report:
        training, validation = simulated_drives(count, recipe, options, report, lidar)
    return [*data, *(shard.folder for shard in training)], validate or [shard.folder for shard in validation]


def _run(
    recipe: Recipe,
    pairs: Pairs,
    tests: Pairs | None,
    folder: Path,
    init_from: tuple[str | None, Weights | None],
    options: RunOptions,
) -> None:
    from hybridlio.learned.training.run_options import Watchers
    from hybridlio.learned.training.train import WEIGHTS
    from hybridlio.learned.training.train import train as run
    from hybridlio.runs.training.recipes import describe_origin

    name, start = init_from
    about = {} if start is None else {"init_from": describe_origin(name or "", start)}
    options = replace(options, about=about)
    tensors = None if start is None else start.fitting(recipe.network)
    if is_first_process():
        print_result(f"{recipe.name}: {len(pairs)} pairs of {len(pairs.shards)} recordings, in {folder}")
    try:
        with first_process_progress("training", "steps") as report:
            watchers = Watchers(lambda p: report(_describe(p), p.step, p.steps), _print_validation)
            run(recipe, pairs, folder, tests, tensors, options, watchers)
    except KeyboardInterrupt:
        print_message("interrupted; the same command resumes")
        raise typer.Exit(INTERRUPTED) from None
    if is_first_process():
        print_result(f"weights  {folder / WEIGHTS}")


def _clear(folder: Path) -> None:
    """Delete the files of a training run, and nothing else."""
    from hybridlio.learned.training.train import BEST, CHECKPOINT, WEIGHTS

    events = (folder / "tensorboard").glob("events.out.tfevents.*")
    files = (folder / name for name in (CHECKPOINT, WEIGHTS, BEST, "log.jsonl", "recipe.json"))
    for path in (*events, *files):  # the recipe last: it identifies the others
        path.unlink(missing_ok=True)
    with suppress(OSError):  # it does not exist, or holds other files
        (folder / "tensorboard").rmdir()


def _describe(p: TrainingProgress) -> str:
    return f"epoch {p.epoch + 1}, loss {p.loss:.4g}, {1e3 * p.po2pl_m:.1f} mm to planes, {p.pairs_per_s:.1f} pairs/s"


def _print_validation(step: int, found: Validation) -> None:
    words = [f"step {step}: validation loss {found.loss:.4g}"]
    if found.translation_rms_m is not None and found.rotation_rms_deg is not None:
        words.append(f"RMS error {1e3 * found.translation_rms_m:.1f} mm, {found.rotation_rms_deg:.3f}°")
    if found.t_rel_percent is not None:
        words.append(f"t_rel {found.t_rel_percent:.3f} %, r_rel {found.r_rel_deg_per_100m:.3f} °/100 m")
    print_message(", ".join(words), "none")
