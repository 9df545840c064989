"""``hybridlio train``."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hybridlio.commands import common
from hybridlio.commands.common import INTERRUPTED, guarded
from hybridlio.commands.terminal import Tick, complain, progress, say
from hybridlio.core.errors import ConfigError
from hybridlio.odometry.registry import INITIAL_POSE_SOURCES

if TYPE_CHECKING:
    from hybridlio.learned.data.pairs import Pairs
    from hybridlio.learned.networks.weights import Weights
    from hybridlio.learned.settings import Recipe
    from hybridlio.learned.training.train import TrainingProgress
    from hybridlio.learned.training.validation import Validation

Recordings = Annotated[
    list[Path], typer.Argument(metavar="DATA…", help="Recordings, folders of them, or shards.", show_default=False)
]
Preset = Annotated[
    str | None,
    typer.Option(
        metavar="NAME", help="default, paper, cho, nubert or another row of the paper's; default unless --init-from."
    ),
]
RecipeFile = Annotated[
    Path | None, typer.Option("--config", metavar="FILE", help="Changes to it: network, loss, optimiser, as YAML.")
]
InitFrom = Annotated[
    str | None, typer.Option("--init-from", metavar="FILE", help="Weights to go on from, or `shipped`.")
]
InitialPose = Annotated[
    str | None,
    typer.Option(
        "--initial-pose",
        metavar="NAME",
        help=f"{', '.join(INITIAL_POSE_SOURCES)}: where the network's initial poses come from.",
    ),
]
Validate = Annotated[
    list[Path] | None, typer.Option("--validate", metavar="DATA", help="Measure on this as it goes; may be repeated.")
]
Split = Annotated[str | None, typer.Option(metavar="NAME", help="Of KITTI odometry: easy or hard. Validates, too.")]
Sequences = Annotated[
    str | None, typer.Option("--sequence", metavar="A,B,…", help="Which recordings, where DATA holds several.")
]
Out = Annotated[
    Path | None, typer.Option("-o", "--out", metavar="DIR", help="The run's folder; by default training/<preset>.")
]
Cache = Annotated[
    Path | None, typer.Option(metavar="DIR", help="Where prepared recordings are kept; by default in -o.")
]
Epochs = Annotated[int | None, typer.Option(min=1, help="Passes over the data.")]
Steps = Annotated[int | None, typer.Option(min=1, help="Steps in all, in place of --epochs.")]
Device = Annotated[str, typer.Option(metavar="NAME", help="cpu, cuda, …; auto is a GPU where there is one.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Start anew in a folder that holds a run.")]


@guarded
def train(
    data: Recordings,
    preset: Preset = None,
    config: RecipeFile = None,
    init_from: InitFrom = None,
    initial_pose: InitialPose = None,
    validate: Validate = None,
    split: Split = None,
    sequence: Sequences = None,
    reader: common.ReaderName = None,
    raw_root: common.RawRoot = None,
    out: Out = None,
    cache: Cache = None,
    epochs: Epochs = None,
    steps: Steps = None,
    device: Device = "auto",
    overwrite: Overwrite = False,
    _verbose: common.Verbose = 0,
) -> None:
    """Train the network, or adapt trained weights, without labels; under torchrun in as many processes as it starts.

    An interrupted run goes on where its last checkpoint was when the same command is given again.
    """
    from hybridlio.learned.networks.devices import pick_device
    from hybridlio.learned.networks.weights import load_weights, weights_path
    from hybridlio.runs.recipes import origin, recipe_for
    from hybridlio.runs.training_data import DataOptions, training_pairs

    pick_device(device)
    if steps is not None and epochs is not None:
        raise ConfigError("--steps and --epochs both say how long to train; give one")
    start = load_weights(weights_path(init_from)) if init_from is not None else None
    recipe = recipe_for(preset, start.recipe if start else None, config, initial_pose, epochs)
    folder = out or Path("training") / recipe.name
    if overwrite and leads():
        clear(folder)
    options = DataOptions(cache or folder / "shards", initial_pose, names(sequence), reader, raw_root)
    with shown("preparing", "scans") as tick:
        pairs, tests = training_pairs(
            data, validate, split, recipe, options, lambda name, done, total: tick(done, total, name)
        )
    about = {"init_from": origin(init_from or "", start)} if start is not None else {}
    _run(recipe, pairs, tests, folder, start, about, device, steps)


def _run(
    recipe: Recipe,
    pairs: Pairs,
    tests: Pairs | None,
    folder: Path,
    start: Weights | None,
    about: dict[str, str],
    device: str,
    steps: int | None,
) -> None:
    from hybridlio.learned.training.train import WEIGHTS, RunOptions, Watchers
    from hybridlio.learned.training.train import train as run
    from hybridlio.runs.recipes import lasting

    if steps is not None:
        recipe = lasting(recipe, steps, len(pairs))
    options = RunOptions(device=None if device == "auto" else device, max_steps=steps, about=about)
    tensors = None if start is None else start.fitting(recipe.network)
    if leads():
        say(f"{recipe.name}: {len(pairs)} pairs of {len(pairs.shards)} recordings, in {folder}")
    try:
        with shown("training", "steps") as tick:
            watchers = Watchers(lambda p: tick(p.step, p.steps, _where(p)), _say_validation)
            run(recipe, pairs, folder, tests, tensors, options, watchers)
    except KeyboardInterrupt:
        complain("interrupted; the same command goes on where this one stopped")
        raise typer.Exit(INTERRUPTED) from None
    if leads():
        say(f"weights  {folder / WEIGHTS}")


def names(text: str | None) -> tuple[str, ...] | None:
    """Names with commas between, as a tuple."""
    return tuple(name.strip() for name in text.split(",") if name.strip()) if text is not None else None


def leads() -> bool:
    """Whether this process, of those that torchrun may have started, is the one that prints."""
    return os.environ.get("RANK", "0") == "0"


@contextmanager
def shown(what: str, unit: str) -> Iterator[Tick]:
    """Progress in the first process, none in others."""
    if not leads():
        yield lambda _done, _total, _detail="": None
        return
    with progress(what, unit) as tick:
        yield tick


def clear(folder: Path) -> None:
    """Delete what a training run leaves, and nothing else."""
    from hybridlio.learned.training.train import BEST, CHECKPOINT, WEIGHTS

    for name in (CHECKPOINT, WEIGHTS, BEST, "recipe.json", "log.jsonl"):
        (folder / name).unlink(missing_ok=True)
    shutil.rmtree(folder / "tensorboard", ignore_errors=True)


def _where(p: TrainingProgress) -> str:
    return f"epoch {p.epoch + 1}, loss {p.loss:.4g}, {1e3 * p.po2pl_m:.1f} mm to planes, {p.pairs_per_s:.1f} pairs/s"


def _say_validation(step: int, found: Validation) -> None:
    words = [f"step {step}: validation loss {found.loss:.4g}"]
    if found.translation_rms_m is not None and found.rotation_rms_deg is not None:
        words.append(f"left {1e3 * found.translation_rms_m:.1f} mm, {found.rotation_rms_deg:.3f}°")
    if found.t_rel_percent is not None:
        words.append(f"t_rel {found.t_rel_percent:.3f} %, r_rel {found.r_rel_deg_per_100m:.3f} °/100 m")
    complain(", ".join(words), "none")
