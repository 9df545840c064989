"""Measure what adaptation without labels takes back where a lidar has systematic errors that training had not.

    python benchmarks/adaptation.py FOLDER [--weights published] [--seeds 3101,3201] [--errors 0.2,0.05]

A drive of 100 m is simulated for each seed, and one of 60 s elsewhere. Both get the lidar errors of
`faults.lidar_errors` (beams off by a standard deviation in degrees, ranges with the intensity in metres). The weights
are adapted on the 60 s (`hybridlio train --weights … `, the recipe of adaptation) and measured on the other drive:
error left in a step of perturbed initial poses 14.5 cm and 0.41° off, against exact poses.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

from front_end import REAL_PERTURBATIONS, Row, adapted, errors_by_step, perturbed

from hybridlio.commands.terminal import progress
from hybridlio.core import tables
from hybridlio.datasets.registry import open_sequence
from hybridlio.datasets.sequence import Sequence
from hybridlio.learned.data.shards import Shard
from hybridlio.learned.networks.odometry_network import OdometryNetwork
from hybridlio.learned.networks.weights import load_weights, weights_path
from hybridlio.learned.settings import Recipe
from hybridlio.runs.training.training_data import DataOptions, prepare_once
from hybridlio.simulation import SimulationConfig, simulate
from hybridlio.simulation.faults import lidar_errors

ADAPTED_S = 60.0


def drive(folder: Path, config: SimulationConfig) -> Sequence:
    """Return a simulated drive, made unless it is there."""
    with progress(f"simulating seed {config.seed}") as report:
        return open_sequence(simulate(folder, config, progress=report))


def shard(sequence: Sequence, name: str, recipe: Recipe, cache: Path) -> Shard:
    """Return the recording prepared for a recipe."""
    folder = cache / f"{recipe.name}-{sequence.name}-{name}"
    with progress(f"preparing {folder.name}") as report:
        prepare_once(sequence, folder, recipe, DataOptions(cache), partial(_report, report, len(sequence)), wait=True)
    return Shard(folder)


def _report(report: object, total: int, done: int) -> None:
    report("", done, total)  # type: ignore[operator]


def left(network: OdometryNetwork, tested: Shard) -> str:
    """Return the error that is left after all steps."""
    rotation_deg, translation_m = REAL_PERTURBATIONS[0]
    reference = tested.reference[1:]
    degrees, metres = errors_by_step(network, tested, reference, perturbed(reference, rotation_deg, translation_m))[-1]
    return f"{100 * metres:.2f} cm / {degrees:.3f}°"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    parser.add_argument("--weights", default="published")
    parser.add_argument("--seeds", default="3101,3201")
    parser.add_argument("--errors", default="0.2,0.05", help="degrees and metres")
    options = parser.parse_args()
    weights = load_weights(weights_path(options.weights))
    recipe, cache = weights.recipe, options.folder / "shards"
    degrees, metres = map(float, options.errors.split(","))
    rows: list[Row] = []
    for seed in map(int, options.seeds.split(",")):
        tested = drive(options.folder, SimulationConfig(seed=seed, length_m=100.0))
        other = drive(options.folder, SimulationConfig(seed=seed + 50, seconds=ADAPTED_S))
        wrong, wrong_other = (lidar_errors(sequence, degrees, metres, seed) for sequence in (tested, other))
        exact = shard(tested, "exact", recipe, cache)
        with_errors = shard(wrong, f"{options.errors}", recipe, cache)
        network = weights.network()
        rows.append(
            {
                "weights": options.weights,
                "seed": str(seed),
                "exact lidar": left(network, exact),
                "with errors": left(network, with_errors),
                "adapted": left(adapted(weights, shard(wrong_other, f"{options.errors}", recipe, cache)), with_errors),
            }
        )
        print(tables.to_markdown(rows, ("weights",)), flush=True)


if __name__ == "__main__":
    main()
