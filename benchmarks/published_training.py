"""Train the ``published`` weights on the shards of ``benchmarks/published_data.py``, and measure them.

    python benchmarks/published_training.py train DIR RUNS [--drives 150] [--epochs 24]
    python benchmarks/published_training.py evaluate WEIGHTS SHARDS… [--iterations N]

``train`` may run while drives are still being simulated: until all are there it trains at a constant rate on those that
are, in phases of half an hour, each from where the last one ended; then the last phase lets the rate fall by a cosine.
Given again, it goes on where it was. Every phase keeps ``best.safetensors``, the weights that validate best.

``evaluate`` chains the network's steps over prepared drives, without a graph; ``benchmarks/front_end.py --long`` does
the same for recordings.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from hybridlio.core.files import write_atomically
from hybridlio.learned.data.pairs import Pairs
from hybridlio.learned.data.shards import Shard
from hybridlio.learned.networks.odometry_network import OdometryNetwork
from hybridlio.learned.networks.weights import load_weights, own_tensors
from hybridlio.learned.presets import preset
from hybridlio.learned.settings import Recipe
from hybridlio.learned.training import checkpoints
from hybridlio.learned.training.driving import drive
from hybridlio.learned.training.run_options import RunOptions, TrainingProgress, Watchers
from hybridlio.learned.training.train import train
from hybridlio.learned.training.validation import step_errors
from hybridlio.learned.training.validation_result import Validation

PHASE_S = 1800.0


def shards_in(folder: Path) -> list[Shard]:
    """Return the shards that are complete, by their names."""
    return [Shard(path.parent) for path in sorted(folder.glob("*/shard.json")) if not path.parent.name.startswith(".")]


def train_in_phases(folder: Path, runs: Path, drives: int, epochs: int) -> None:
    """Train on the drives there are, phase by phase, and on all of them at the end."""
    recipe, start = preset("published"), None
    constant = replace(recipe.optimiser, schedule="step", step_epochs=10**6, epochs=10**4)
    for number in range(100):
        run = runs / f"phase-{number}"
        names = _shards_of_run(run, folder)
        last = len(names) >= drives
        phase = replace(recipe, optimiser=replace(recipe.optimiser, epochs=epochs) if last else constant)
        checkpoint = run / "checkpoint.pt"
        if not (run / "phase.done").is_file():
            pairs = Pairs([Shard(folder / "training" / name) for name in names], recipe.network)
            validation = Pairs(shards_in(folder / "validation"), recipe.network)
            print(
                f"{run.name}: {len(pairs)} pairs of {len(names)} drives, {'cosine' if last else 'constant'}", flush=True
            )
            options = RunOptions("cpu", max_seconds=None if last else PHASE_S)
            train(phase, pairs, run, validation, start, options, Watchers(_say_now_and_then, _say_validation))
            write_atomically(run / "phase.done", "")
        if last:
            return
        start = _weights_in(checkpoint, phase)


def _shards_of_run(run: Path, folder: Path) -> list[str]:
    """Return the drives of a phase: those that it began with, or those there are now."""
    listed = run / "drives.txt"
    if not listed.is_file():
        names = [shard.folder.name for shard in shards_in(folder / "training")]
        run.mkdir(parents=True, exist_ok=True)
        write_atomically(listed, "\n".join(names) + "\n")
    return listed.read_text(encoding="utf-8").split()


def _weights_in(checkpoint: Path, recipe: Recipe) -> dict[str, Tensor]:
    network = OdometryNetwork(recipe.network)
    network.load_state_dict(checkpoints.load(checkpoint).network)
    return own_tensors(network)


def _say_now_and_then(p: TrainingProgress) -> None:
    if p.step % 200 == 0:
        print(f"step {p.step} of {p.steps}: loss {p.loss:.4f}, {p.pairs_per_s:.1f} pairs/s", flush=True)


def _say_validation(step: int, found: Validation) -> None:
    print(
        f"step {step}: validation loss {found.loss:.4f}, left {100 * (found.translation_rms_m or 0):.2f} cm / "
        f"{found.rotation_rms_deg or 0:.3f}° of {100 * (found.initial_translation_rms_m or 0):.2f} cm / "
        f"{found.initial_rotation_rms_deg or 0:.3f}°, t_rel {found.t_rel_percent or 0:.2f} %, "
        f"r_rel {found.r_rel_deg_per_100m or 0:.2f} °/100 m",
        flush=True,
    )


def evaluate(weights: Path, shards: list[Shard], iterations: int) -> None:
    """Print the drift of the chained steps of each drive."""
    network = load_weights(weights).asked(iterations).network()
    for shard in shards:
        driven = drive(network, shard)
        length_m = float(np.linalg.norm(driven.reference[:, :3, 3], axis=1).sum())
        t_rel, r_rel = driven.drift or (float("nan"), float("nan"))
        left, initial = (step_errors(poses, driven.reference) for poses in (driven.poses, driven.initial))
        print(
            f"{shard.info.name}: {length_m:.0f} m, t_rel {t_rel:.2f} %, r_rel {r_rel:.2f} °/100 m, "
            f"step {100 * left[1]:.1f} cm / {left[0]:.3f}°, LSTM {100 * initial[1]:.1f} cm / {initial[0]:.3f}°",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    two = commands.add_parser("train", help="train on the shards")
    two.add_argument("folder", type=Path, metavar="DIR")
    two.add_argument("runs", type=Path, metavar="RUNS")
    two.add_argument("--drives", type=int, default=150, help="training drives to wait for")
    two.add_argument("--epochs", type=int, default=24, help="of the last phase")
    three = commands.add_parser("evaluate", help="drift of the chained steps")
    three.add_argument("weights", type=Path)
    three.add_argument("shards", type=Path, nargs="+", help="folders of shards")
    three.add_argument("--iterations", type=int, default=0, metavar="N", help="ask N times (default: as trained)")
    options = parser.parse_args()
    torch.set_num_threads(1)
    if options.command == "train":
        train_in_phases(options.folder, options.runs, options.drives, options.epochs)
    else:
        shards = [shard for folder in options.shards for shard in shards_in(folder)]
        evaluate(options.weights, shards, options.iterations)


if __name__ == "__main__":
    main()
