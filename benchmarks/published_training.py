"""Make the training data of the ``published`` weights, train them, and measure them.

    python benchmarks/published_training.py simulate DIR [--poses KITTI_POSES] [--drives 150] [--minutes 90]
    python benchmarks/published_training.py train DIR RUNS [--drives 150] [--epochs 24]
    python benchmarks/published_training.py evaluate WEIGHTS SHARDS…

``simulate`` writes one shard a drive: it plans a drive, computes its scans in memory, runs odometry by scan matching
over them for the last velocity of each pair, and prepares them. Nothing else touches the disk. A shard appears when it
is complete, so an interrupted run goes on with the next drive. Seeds 41000 up are training drives, 45000 up validation
drives; test drives have other seeds.

``train`` may run beside ``simulate``: until all drives are there it trains at a constant rate on those that are, in
phases of half an hour, each from where the last one ended; then the last phase lets the rate fall by a cosine. Given
again, it goes on where it was. Every phase keeps ``best.safetensors``, the weights that validate best.

``evaluate`` chains the network's steps over prepared drives, without a graph; ``benchmarks/front_end.py --long`` does
the same for recordings.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from hybridlio.cloud.preparation import prepare
from hybridlio.core.arrays import Array
from hybridlio.core.files import write_atomically
from hybridlio.core.sensors import LIDAR_MODELS, LidarModel, Scan
from hybridlio.datasets.sequence import Sequence
from hybridlio.learned.data.pairs import Pairs
from hybridlio.learned.data.preparing import KnownMotion, prepare_shard
from hybridlio.learned.data.shards import Shard
from hybridlio.learned.networks.odometry_network import OdometryNetwork
from hybridlio.learned.networks.weights import load_weights, own_tensors
from hybridlio.learned.presets import preset
from hybridlio.learned.settings import Recipe
from hybridlio.learned.training import checkpoints
from hybridlio.learned.training.driving import drive
from hybridlio.learned.training.train import RunOptions, TrainingProgress, Watchers, train
from hybridlio.learned.training.validation import Validation, step_errors
from hybridlio.odometry.config import Config
from hybridlio.odometry.odometry import Odometry
from hybridlio.odometry.registry import preparation_for
from hybridlio.runs.run import run_odometry
from hybridlio.simulation import SimulationConfig
from hybridlio.simulation.recording import simulated_recording

TRAINING_SEED, VALIDATION_SEED = 41000, 45000
VALIDATION_DRIVES = 10
SECONDS = 22.0
COLUMNS = (750, 937, 1250)  # a fraction of the HDL-64E's 1875: the reduced maps have 360 columns
PATHS = ("00", "02", "03", "05", "07", "08")  # 01 and 06 are test drives
PHASE_S = 1800.0
UNSURE_STEP_M = 0.05  # as in runs/training_data.py: a step that scans determine less well gives no velocity


def lidar_of(rng: np.random.Generator) -> LidarModel:
    """Return an HDL-64E whose beams lie a little elsewhere, with fewer columns."""
    model = LIDAR_MODELS["hdl-64e"]
    scale, shift_deg = 1 + 0.02 * rng.normal(), 0.2 * rng.normal()
    elevations = scale * np.array(model.elevations_deg) + shift_deg + 0.04 * rng.normal(size=model.beams)
    return replace(model, elevations_deg=tuple(np.sort(elevations)[::-1].tolist()), columns=int(rng.choice(COLUMNS)))


def drive_of(seed: int, poses: Path | None, folder: Path) -> tuple[SimulationConfig, LidarModel]:
    """Draw the settings of a drive from its seed; one in four goes along a part of a real path, where given."""
    rng = np.random.default_rng([seed, 1])
    lidar = lidar_of(rng)
    traffic, parked = float(rng.uniform(0, 60)), float(rng.uniform(0, 0.9))
    along, path, start = rng.random() < 0.25, str(rng.choice(PATHS)), rng.random()
    common = {"seed": seed, "seconds": SECONDS, "traffic_per_km": traffic, "parked": parked}
    if along and poses is not None:
        rows = (poses / f"{path}.txt").read_text(encoding="utf-8").splitlines(keepends=True)
        first = int(start * max(len(rows) - 10 * SECONDS - 10, 0))
        part = folder / f"{seed}.txt"
        part.write_text("".join(rows[first : first + int(10 * SECONDS) + 10]), encoding="utf-8")
        return SimulationConfig(**common, poses=part), lidar
    config = SimulationConfig(
        **common,
        speed_m_s=float(rng.uniform(2, 33)),
        driving="hard" if rng.random() < 0.3 else "calm",
        scene=str(rng.choice(["town", "field", "corridor"], p=[0.85, 0.12, 0.03])),  # type: ignore[arg-type]
        start_moving=bool(rng.random() < 0.8),
        loops=bool(rng.random() < 0.15),
    )
    return config, lidar


def in_memory(sequence: Sequence) -> Sequence:
    """Return the recording with each scan computed once."""
    scans: dict[int, Scan] = {}

    def load(k: int) -> Scan:
        if k not in scans:
            scans[k] = sequence.load_scan(k)
        return scans[k]

    return replace(sequence, load_scan=load)


def odometry_steps(sequence: Sequence) -> dict[int, Array]:
    """Return the steps ``T_k_k1`` by the scan that they lead to, where scans determine them."""
    run = run_odometry(sequence, Odometry(config=Config(initial_pose="preintegration", residual="scan-matching")))
    if run.stopped is not None:
        raise run.stopped
    known = [e for e in run.estimates if e.step is not None and e.relative is not None and e.relative.ok]
    return {
        e.index: e.step.pose
        for e in known
        if e.step is not None and e.relative is not None and e.relative.translation_sigma_m <= UNSURE_STEP_M
    }


def simulate(folder: Path, seeds: list[int], poses: Path | None, minutes: float) -> None:
    """Write the shards of drives that are not there yet, until time is up."""
    recipe, began = preset("published"), time.monotonic()
    options = replace(preparation_for(recipe), threads=1)
    folder.mkdir(parents=True, exist_ok=True)
    for seed in seeds:
        place = folder / f"{seed}"
        if (place / "shard.json").is_file():
            continue
        if time.monotonic() - began > 60 * minutes:
            return
        start = time.monotonic()
        with tempfile.TemporaryDirectory() as scratch:
            config, lidar = drive_of(seed, poses, Path(scratch))
            sequence = in_memory(simulated_recording(config, lidar))
            steps = odometry_steps(sequence)
            between = time.monotonic()
            prepare_shard(
                sequence,
                place,
                partial(prepare, options=options),
                recipe.network,
                KnownMotion(
                    step=lambda frame, steps=steps: steps.get(frame.index),  # type: ignore[misc]
                    source=f"benchmarks/published_training.py, {config.model_dump_json()}",
                ),
            )
        done = time.monotonic()
        print(
            f"{seed}: {len(sequence)} scans, {len(steps)} steps, {config.scene}, {config.speed_m_s:.0f} m/s, "
            f"{between - start:.0f} + {done - between:.0f} s",
            flush=True,
        )


def simulate_all(folder: Path, drives: int, poses: Path | None, minutes: float) -> None:
    """Write all shards; a few of either kind first, so that a network can be tried soon."""
    validation = [VALIDATION_SEED + k for k in range(VALIDATION_DRIVES)]
    training = [TRAINING_SEED + k for k in range(drives)]
    began = time.monotonic()
    parts = (
        ("training", 6),
        ("validation", 3),
        ("training", 40),
        ("validation", VALIDATION_DRIVES),
        ("training", drives),
    )
    for part, count in parts:
        seeds = (training if part == "training" else validation)[:count]
        simulate(folder / part, seeds, poses, minutes - (time.monotonic() - began) / 60)


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
        done = (run / "phase.done").is_file()
        if not done:
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


def evaluate(weights: Path, shards: list[Shard]) -> None:
    """Print the drift of the chained steps of each drive."""
    network = load_weights(weights).network()
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
    one = commands.add_parser("simulate", help="write shards")
    one.add_argument("folder", type=Path, metavar="DIR")
    one.add_argument("--poses", type=Path, help="folder of KITTI pose files to drive along")
    one.add_argument("--drives", type=int, default=150)
    one.add_argument("--minutes", type=float, default=float("inf"))
    two = commands.add_parser("train", help="train on the shards")
    two.add_argument("folder", type=Path, metavar="DIR")
    two.add_argument("runs", type=Path, metavar="RUNS")
    two.add_argument("--drives", type=int, default=150, help="training drives to wait for")
    two.add_argument("--epochs", type=int, default=24, help="of the last phase")
    three = commands.add_parser("evaluate", help="drift of the chained steps")
    three.add_argument("weights", type=Path)
    three.add_argument("shards", type=Path, nargs="+", help="folders of shards")
    options = parser.parse_args()
    torch.set_num_threads(1)
    if options.command == "train":
        train_in_phases(options.folder, options.runs, options.drives, options.epochs)
    elif options.command == "evaluate":
        evaluate(options.weights, [shard for folder in options.shards for shard in shards_in(folder)])
    else:
        simulate_all(options.folder, options.drives, options.poses, options.minutes)


if __name__ == "__main__":
    main()
