"""Measure the effect of each departure of the default network from the paper's; all train for the same number of steps.

    python benchmarks/departures.py DRIVE… --test DRIVE… [--steps 100] [--rows A,B] [--cache DIR] [-o DIR]

DRIVE is a recording with a reference, such as a simulated one, or its shard. A second call with the same -o does not
train finished rows again. The first row is the untrained network.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import torch
from front_end import PERTURBATIONS, Row

from hybridlio.core import tables
from hybridlio.core.files import write_atomically
from hybridlio.learned.data.pairs import Pairs
from hybridlio.learned.data.shards import Shard
from hybridlio.learned.networks.odometry_network import OdometryNetwork, parameter_count
from hybridlio.learned.presets import DEFAULT, DEPARTURES
from hybridlio.learned.settings import Recipe
from hybridlio.learned.training.driving import drive
from hybridlio.learned.training.run_options import RunOptions
from hybridlio.learned.training.train import train
from hybridlio.learned.training.validation import errors_by_step, step_errors, with_errors
from hybridlio.runs.training.recipes import for_steps
from hybridlio.runs.training.training_data import DataOptions, prepare_shards


def measure(name: str, network: OdometryNetwork, tests: list[Shard]) -> Iterator[Row]:
    """Yield a row for each test recording: error left of the larger perturbation, drift of the chained steps."""
    for shard in tests:
        reference = shard.reference[1:]
        degrees, metres = errors_by_step(network, shard, reference, with_errors(reference, *PERTURBATIONS[0]))[-1]
        driven = drive(network, shard)
        initial_deg, initial_m = step_errors(driven.initial, driven.reference)
        t_rel, r_rel = driven.drift or (None, None)
        yield {
            "preset": name,
            "parameters": str(parameter_count(network)),
            "recording": shard.info.name,
            "error left of 14.5 cm / 0.41°": f"{100 * metres:.2f} cm / {degrees:.3f}°",
            "error of the initial pose": f"{100 * initial_m:.1f} cm / {initial_deg:.2f}°",
            "t_rel [%]": tables.number(t_rel, 2),
            "r_rel [°/100 m]": tables.number(r_rel, 2),
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("train", type=Path, nargs="+", metavar="DRIVE", help="to train on")
    parser.add_argument("--test", type=Path, nargs="+", required=True, metavar="DRIVE", help="to measure on")
    parser.add_argument("--steps", type=int, default=100, help="of training (default: %(default)s)")
    parser.add_argument("--rows", default="", metavar="A,B", help="presets (default: all departures)")
    parser.add_argument("--cache", type=Path, default=Path("shards"), metavar="DIR", help="for shards")
    parser.add_argument(
        "-o", "--out", type=Path, default=Path("departures"), metavar="DIR", help="for weights and table"
    )
    options = parser.parse_args()
    wanted = [name for name in options.rows.split(",") if name]
    prepared = DataOptions(options.cache)

    def tests(recipe: Recipe) -> list[Shard]:
        return prepare_shards(options.test, recipe, prepared)

    torch.manual_seed(0)
    rows = list(measure("default, untrained", OdometryNetwork(DEFAULT.network).eval(), tests(DEFAULT)))
    for recipe in DEPARTURES:
        if wanted and recipe.name not in wanted:
            continue
        pairs = Pairs(prepare_shards(options.train, recipe, prepared), recipe.network)
        recipe = for_steps(recipe, options.steps, len(pairs))
        network = train(
            recipe, pairs, options.out / recipe.name, options=RunOptions(device="cpu", max_steps=options.steps)
        )
        rows += measure(recipe.name, network.eval(), tests(recipe))
        print(tables.to_markdown(rows[-len(options.test) :], ("preset", "recording")), flush=True)
    text = tables.to_markdown(rows, ("preset", "recording"))
    write_atomically(options.out / "departures.md", text + "\n")
    print(text)


if __name__ == "__main__":
    main()
