"""Measure what adaptation without labels takes back where a lidar differs from that of the training.

    python benchmarks/adaptation.py FOLDER [--weights published] [--seeds 3101,3201] [--differences calibration,all]
    python benchmarks/adaptation.py FOLDER --minimum

Differences, each alone or all together:

* calibration: beams off by 0.2° (standard deviation), ranges by 5 cm between reflectances of 0 and 1;
* rolling-shutter: the car moves during a sweep, and points have no times by which to compensate it;
* height: the lidar, with the IMU, is mounted half a metre higher, as on a van.

A drive of 100 m is simulated for each seed, and one of 60 s elsewhere, both with the difference. The weights are
adapted on the 60 s (`hybridlio train --weights … `, the recipe of adaptation) and measured on the other drive: error
left in a step of perturbed initial poses 14.5 cm and 0.41° off, against exact poses. Training and the exact lidar have
instantaneous scans. FOLDER keeps prepared drives for the next time.

--config changes the recipe of adaptation, as that of `hybridlio train` does. --minimum adapts nothing and measures how
far from the exact poses the training loss has its minimum: what a network that reached it in each pair would leave.
"""

from __future__ import annotations

import argparse
import functools
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from front_end import REAL_PERTURBATIONS, adapted

from hybridlio.commands.terminal import progress
from hybridlio.core import se3, tables
from hybridlio.core.sensors import Scan
from hybridlio.datasets.sequence import Sequence
from hybridlio.learned.data.pairs import Pairs
from hybridlio.learned.data.shards import Shard
from hybridlio.learned.networks.odometry_network import OdometryNetwork
from hybridlio.learned.networks.weights import Weights, load_weights, weights_path
from hybridlio.learned.settings import Recipe
from hybridlio.learned.training.objective import clouds_for, descended
from hybridlio.learned.training.validation import errors_by_step, step_errors, with_errors
from hybridlio.runs.training.training_data import DataOptions, prepare_once
from hybridlio.simulation import SimulationConfig
from hybridlio.simulation.drive.path import SmoothPath
from hybridlio.simulation.faults import lidar_errors
from hybridlio.simulation.plan import Drive, plan
from hybridlio.simulation.recording import drive_recording

DIFFERENCES = ("calibration", "rolling-shutter", "height", "all")
ADAPTED_S, LENGTH_M = 60.0, 100.0
HIGHER_M = 0.5
MINIMUM_STEPS, MINIMUM_EVERY = 12, 4  # Gauss-Newton steps from the exact pose, in every fourth pair
LEAST_COST = 0.1  # of the exact lidar's error; less is chance
_PATH_STEP_S = 0.05  # of the poses that the raised path goes through

Preparing = Callable[[Sequence], Shard]


class Left(NamedTuple):
    """The error that is left after all steps."""

    degrees: float
    metres: float

    def __str__(self) -> str:
        return f"{100 * self.metres:.2f} cm / {self.degrees:.3f}°"


def recording(config: SimulationConfig, difference: str, lidar: int) -> Sequence:
    """Return a simulated drive with a difference; ``exact`` is none. Scans are computed once, on access.

    Args:
        config: of the drive.
        difference: one of ``DIFFERENCES``, or ``exact``.
        lidar: the seed of the specimen's errors.
    """
    has = {difference} if difference != "all" else set(DIFFERENCES)
    config = config.model_copy(update={"motion_distortion": "rolling-shutter" in has})
    drive = plan(config)
    exact = drive_recording(raised(drive, HIGHER_M) if "height" in has else drive, config)
    wrong = lidar_errors(exact, seed=lidar) if "calibration" in has else exact

    @functools.cache
    def load(k: int) -> Scan:
        return replace(wrong.load_scan(k), time_offsets_ns=None)

    return replace(wrong, name=f"{config.seed}-{difference}", load_scan=load)


def raised(drive: Drive, metres: float) -> Drive:
    """Return the drive with all sensors mounted higher."""
    path = drive.path
    times = np.linspace(path.start_s, path.end_s, round((path.end_s - path.start_s) / _PATH_STEP_S) + 1)
    return replace(drive, path=SmoothPath.through(times, path.poses(times) @ se3.make(np.eye(3), [0.0, 0.0, metres])))


def shard(sequence: Sequence, recipe: Recipe, cache: Path) -> Shard:
    """Return the recording prepared for a recipe."""
    folder = cache / f"{recipe.name}-{sequence.name}"
    with progress(f"preparing {folder.name}") as report:
        prepare_once(sequence, folder, recipe, DataOptions(cache), partial(_report, report, len(sequence)), wait=True)
    return Shard(folder)


def _report(report: object, total: int, done: int) -> None:
    report("", done, total)  # type: ignore[operator]


def left(network: OdometryNetwork, tested: Shard) -> Left:
    """Return the error that is left after all steps."""
    rotation_deg, translation_m = REAL_PERTURBATIONS[0]
    reference = tested.reference[1:]
    return Left(*errors_by_step(network, tested, reference, with_errors(reference, rotation_deg, translation_m))[-1])


def minimum(recipe: Recipe, tested: Shard) -> Left:
    """Return how far from the exact poses the loss has its minimum, by Gauss-Newton steps from there."""
    settings = replace(recipe.loss, target_steps=MINIMUM_STEPS)
    pairs = Pairs([tested], replace(recipe.network, velocity=False))
    batches = [pairs.batch([i]) for i in range(0, len(pairs), MINIMUM_EVERY)]
    found = [descended(b.reference, clouds_for(b, settings), settings, recipe.network.geometry) for b in batches]
    exact = torch.cat([b.reference for b in batches])
    return Left(*step_errors(torch.cat(found).double().numpy(), exact.double().numpy()))


def taken_back(exact: Left, wrong: Left, after: Left) -> str:
    """Return the shares of what a difference costs that adaptation takes back; none where it costs nothing."""

    def share(a: float, b: float, c: float) -> str:
        return f"{100 * (b - c) / (b - a):.0f} %" if b > (1 + LEAST_COST) * a else tables.NOTHING

    turns, shifts = (share(*three) for three in zip(exact, wrong, after, strict=True))
    return f"{shifts} / {turns}"


def drive(seed: int, difference: str, prepared: Preparing) -> Shard:
    """Return the drive that is measured, with a difference."""
    return prepared(recording(SimulationConfig(seed=seed, length_m=LENGTH_M), difference, seed))


def adaptations(
    weights: Weights, prepared: Preparing, difference: str, seed: int, exact: Left, changes: Path | None = None
) -> dict[str, str]:
    """Return a row of errors left before and after adaptation; ``exact`` is that on the exact lidar."""
    differing = drive(seed, difference, prepared)
    wrong = left(weights.network(), differing)
    other = recording(SimulationConfig(seed=seed + 50, seconds=ADAPTED_S), difference, seed)
    after = left(adapted(weights, prepared(other), changes), differing)
    row = {"exact lidar": str(exact), "differing": str(wrong), "adapted": str(after)}
    return {**row, "taken back": taken_back(exact, wrong, after)}


def minima(weights: Weights, prepared: Preparing, difference: str, seed: int, exact: Left) -> dict[str, str]:
    """Return a row of the distances of the loss's minimum; ``exact`` is that on the exact lidar."""
    return {"exact lidar": str(exact), "differing": str(minimum(weights.recipe, drive(seed, difference, prepared)))}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    parser.add_argument("--weights", default="published")
    parser.add_argument("--seeds", default="3101,3201")
    parser.add_argument("--differences", default=",".join(DIFFERENCES), metavar="A,B,…", help="(default: all four)")
    parser.add_argument("--config", type=Path, metavar="FILE", help="changes of the recipe")
    parser.add_argument("--minimum", action="store_true", help="measure the minimum of the loss instead")
    options = parser.parse_args()
    differences = options.differences.split(",")
    if unknown := [name for name in differences if name not in DIFFERENCES]:
        parser.error(f"unknown difference {unknown[0]!r}; choose among {', '.join(DIFFERENCES)}")
    weights = load_weights(weights_path(options.weights))
    prepared = partial(shard, recipe=weights.recipe, cache=options.folder / "shards")
    of: Callable[..., dict[str, str]] = minima if options.minimum else partial(adaptations, changes=options.config)

    @functools.cache  # differences share it
    def exact(seed: int) -> Left:
        shown = drive(seed, "exact", prepared)
        return minimum(weights.recipe, shown) if options.minimum else left(weights.network(), shown)

    rows: list[dict[str, str]] = []
    for difference in differences:
        for seed in map(int, options.seeds.split(",")):
            row = of(weights, prepared, difference, seed, exact(seed))
            rows.append({"difference": difference, "seed": str(seed), **row})
            print(tables.to_markdown(rows, ("difference",)), flush=True)


if __name__ == "__main__":
    main()
