"""How good the learned front end is, and what it costs: accuracy of a step, drift without a graph, time by stage.

    python benchmarks/front_end.py --simulated DRIVE… --real DRIVE… --long DRIVE… --adapt --time [--cache DIR] [-o DIR]

`--simulated` shakes true relative poses and measures what the network leaves of the error. `--real` does the same on
recordings without an exact reference, around what small_gicp finds between full scans. `--adapt` trains the weights on
each of two or more real recordings, without labels, and measures on the others. `--long` chains the steps of LSTMs and
network, without a graph. `--time` takes the first two scans of the first recording given. Prints Markdown; -o keeps the
figures.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import small_gicp
import torch

from hybridlio.cloud.preparation import prepare
from hybridlio.cloud.projection import vertex_map
from hybridlio.core import se3, tables
from hybridlio.core.arrays import Array
from hybridlio.core.files import write_atomically
from hybridlio.datasets.registry import open_sequence
from hybridlio.datasets.sequence import Sequence
from hybridlio.learned.data.pairs import Pairs
from hybridlio.learned.data.shards import Shard
from hybridlio.learned.networks.odometry_network import OdometryNetwork
from hybridlio.learned.networks.weights import Weights, load_weights, weights_path
from hybridlio.learned.training.driving import drive
from hybridlio.learned.training.train import RunOptions, train
from hybridlio.learned.training.validation import step_errors
from hybridlio.runs.recipes import adaptation_recipe
from hybridlio.runs.training_data import DataOptions, prepare_shards

Row = dict[str, str]

SIZES = ((0.41, 0.145), (0.10, 0.054))  # degrees and metres, root mean square over pairs
REAL_SIZES = ((0.41, 0.149),)
THIN_M, REACH_M = 0.2, 1.0  # of small_gicp's registration


def shaken(reference: Array, rotation_deg: float, translation_m: float) -> Array:
    """Poses ``(N, 4, 4)`` whose errors are of these sizes, root mean square, the same draws every time."""
    sigmas = np.r_[np.full(3, np.radians(rotation_deg)), np.full(3, translation_m)] / np.sqrt(3)
    draws = np.random.default_rng(0).normal(size=(len(reference), 6)) * sigmas
    return reference @ se3.exp(draws)


@torch.no_grad()
def steps_left(network: OdometryNetwork, shard: Shard, reference: Array, initial: Array) -> list[tuple[float, float]]:
    """Degrees and metres left before, and after each of the network's steps, over all pairs of a shard."""
    # of every pair, also those whose last velocity nobody knows: it does not matter here
    pairs, poses = Pairs([shard], replace(network.settings, velocity=False)), []
    rows = [pairs.where(i)[1] - 1 for i in range(len(pairs))]
    for i, row in enumerate(rows):
        given = pairs.batch([i]).network
        start = torch.tensor(initial[row], dtype=torch.float32)[None]
        poses.append(torch.stack(network.refine(given, start).poses)[:, 0].double().numpy())
    found = np.swapaxes(np.array(poses), 0, 1)
    return [step_errors(steps, reference[rows]) for steps in (initial[rows], *found)]


def gicp_steps(sequence: Sequence) -> Array:
    """``T_k_k1`` ``(N, 4, 4)`` by generalised ICP between full scans, from the recording's own reference."""
    assert sequence.reference is not None
    steps, last = [], None
    for k in range(len(sequence)):
        points = prepare(sequence[k].scan).points.astype(np.float64)
        cloud, tree = small_gicp.preprocess_points(points, downsampling_resolution=THIN_M, num_threads=2)
        if last is not None:
            start = se3.between(sequence.reference.poses[k - 1], sequence.reference.poses[k])
            found = small_gicp.align(
                last[0], cloud, last[1], start, registration_type="GICP", max_correspondence_distance=REACH_M,
                num_threads=2,
            )  # fmt: skip
            steps.append(np.asarray(found.T_target_source))
        last = cloud, tree
    return np.array(steps)


def accuracy_rows(network: OdometryNetwork, name: str, shard: Shard, reference: Array, sizes: object) -> Iterator[Row]:
    for rotation_deg, translation_m in sizes:  # type: ignore[attr-defined]
        figures = steps_left(network, shard, reference, shaken(reference, rotation_deg, translation_m))
        cells = [f"{100 * metres:.2f} cm / {degrees:.3f}°" for degrees, metres in figures]
        yield {"recording": name, "initial error": cells[0], "after one step": cells[1], "left": cells[-1]}


def adapted(weights: Weights, shard: Shard) -> OdometryNetwork:
    """The network after going on with its training on a recording, without labels."""
    recipe = adaptation_recipe(weights.recipe)
    with tempfile.TemporaryDirectory() as folder:
        start = weights.fitting(recipe.network)
        return train(recipe, Pairs([shard], recipe.network), folder, start=start, options=RunOptions("cpu")).eval()


def stages(network: OdometryNetwork, sequence: Sequence) -> dict[str, Callable[[], object]]:
    """What is done for each scan, one stage at a time, and registration by small_gicp to compare with."""
    last, current = (prepare(sequence[k].scan).points for k in (0, 1))
    geometry, thinned = network.settings.geometry, THIN_M
    maps = [torch.from_numpy(vertex_map(points, geometry))[None] for points in (last, current)]
    seen = [network.look(one) for one in maps]
    start = torch.eye(4)[None]
    imu, velocity, dt = torch.zeros(1, network.settings.imu_samples, 6), torch.zeros(1, 3), torch.full((1,), 0.1)

    def all_of_it() -> None:
        vertices = torch.from_numpy(vertex_map(current, geometry))[None]
        assert network.imu_network is not None
        pose = network.imu_network(imu, velocity, dt)
        network.refine_seen(seen[0], network.look(vertices), pose)

    def registration() -> None:
        target = small_gicp.preprocess_points(last.astype(np.float64), thinned, num_threads=torch.get_num_threads())
        source = small_gicp.preprocess_points(current.astype(np.float64), thinned, num_threads=torch.get_num_threads())
        small_gicp.align(target[0], source[0], target[1], num_threads=torch.get_num_threads())

    return {
        "vertex map": lambda: vertex_map(current, geometry),
        "normal map, features": lambda: network.look(maps[1]),
        "LSTMs": lambda: network.imu_network(imu, velocity, dt),  # type: ignore[misc]
        "residual": lambda: network.refine_seen(seen[0], seen[1], start),
        "both maps and network": all_of_it,
        "small_gicp, both scans": registration,
    }


@torch.no_grad()
def time_rows(network: OdometryNetwork, sequence: Sequence, threads: int, runs: int = 30) -> list[Row]:
    """Median milliseconds of each stage by the clock and of the processor, all in turn, and as a share of small_gicp's.

    A busy machine lengthens the former; with several threads, waiting for each other counts as work in the latter.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    calls = stages(network, sequence)
    clocks = (time.perf_counter, time.process_time)
    took: dict[str, list[Array]] = {name: [] for name in calls}
    for _ in range(runs + 3):
        for name, call in calls.items():
            start = np.array([clock() for clock in clocks])
            call()
            took[name].append(1e3 * (np.array([clock() for clock in clocks]) - start))
    torch.set_num_threads(before)
    medians = {name: np.median(times[3:], axis=0) for name, times in took.items()}
    peer = list(medians.values())[-1]
    return [
        {
            "stage": name,
            "threads": str(threads),
            "median [ms]": f"{median[0]:.1f}",
            "processor, median [ms]": f"{median[1]:.1f}",
            "processor, least [ms]": f"{min(times[1] for times in took[name]):.1f}",
            "processor, of small_gicp": f"{median[1] / peer[1]:.2f}",
        }
        for name, median in medians.items()
    ]


def drift_rows(network: OdometryNetwork, shards: list[Shard]) -> Iterator[Row]:
    for shard in shards:
        driven = drive(network, shard)
        length = float(np.linalg.norm(driven.reference[:, :3, 3], axis=1).sum())
        (t_rel, r_rel), lstm = driven.drift or (None, None), step_errors(driven.initial, driven.reference)
        yield {
            "recording": shard.info.name,
            "length [m]": f"{length:.0f}",
            "t_rel [%]": tables.number(t_rel, 2),
            "r_rel [°/100 m]": tables.number(r_rel, 2),
            "initial pose off by": f"{100 * lstm[1]:.1f} cm / {lstm[0]:.3f}°",
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", default="shipped")
    for name in ("--simulated", "--real", "--long"):
        parser.add_argument(name, type=Path, nargs="*", default=[])
    parser.add_argument("--adapt", action="store_true")
    parser.add_argument("--time", action="store_true")
    parser.add_argument("--cache", type=Path, default=Path("shards"))
    parser.add_argument("-o", "--out", type=Path)
    options = parser.parse_args()
    weights = load_weights(weights_path(options.weights))
    network, told = weights.network(), {}

    def shards(paths: list[Path]) -> list[Shard]:
        return prepare_shards(paths, weights.recipe, DataOptions(options.cache)) if paths else []

    def show(title: str, rows: list[Row]) -> None:
        if rows:
            told[title] = rows
            print(f"\n{title}\n\n{tables.to_markdown(rows, ('recording', 'stage', 'weights'))}", flush=True)

    rows = [
        row for s in shards(options.simulated) for row in accuracy_rows(network, s.info.name, s, s.reference[1:], SIZES)
    ]
    show("Simulated drives", rows)
    real = [(open_sequence(path), s) for path, s in zip(options.real, shards(options.real), strict=True)]
    steps = {s.info.name: gicp_steps(sequence) for sequence, s in real}
    rows = [row for _, s in real for row in accuracy_rows(network, s.info.name, s, steps[s.info.name], REAL_SIZES)]
    show("Real recordings", rows)
    for _, one in real if options.adapt and len(real) > 1 else []:
        after = adapted(weights, one)
        others = [s for _, s in real if s is not one]
        rows = [r for s in others for r in accuracy_rows(after, s.info.name, s, steps[s.info.name], REAL_SIZES)]
        show(f"Adapted to {one.info.name}", rows)
    show("Without a graph", list(drift_rows(network, shards(options.long))))
    if options.time:
        first = (options.simulated + options.real + options.long)[0]
        show("Time for each scan", [row for n in (1, 2) for row in time_rows(network, open_sequence(first), n)])
    if options.out:
        write_atomically(options.out / "front_end.json", json.dumps(told, indent=2) + "\n")


if __name__ == "__main__":
    main()
