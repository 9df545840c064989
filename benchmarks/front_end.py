"""Measure the learned front end: error left in a step, drift without a graph, adaptation, time by stage.

    python benchmarks/front_end.py --simulated DRIVE… --real DRIVE… --long DRIVE… --adapt --time [--cache DIR] [-o DIR]

`--simulated` perturbs true relative poses and measures the error that the network leaves. `--real` does the same for
recordings without an exact reference; small_gicp's registration of full scans takes its place. `--adapt` trains the
weights on each of two or more real recordings, without labels, and measures on the others. `--iterations` asks for
the residual another number of times than in training. `--long` chains the steps of LSTMs and network, without a graph.
Each figure is also given for networks that are not trained. `--time` measures the first two scans of the first
recording given. Prints Markdown; -o writes all figures to front_end.json.
"""

from __future__ import annotations

import argparse
import itertools
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
from hybridlio.learned.settings import NetworkSettings
from hybridlio.learned.training.driving import drive
from hybridlio.learned.training.run_options import RunOptions
from hybridlio.learned.training.train import train
from hybridlio.learned.training.validation import errors_by_step, step_errors, with_errors
from hybridlio.runs.training.recipes import choose_recipe
from hybridlio.runs.training.training_data import DataOptions, prepare_shards

Row = dict[str, str]
Networks = dict[str, OdometryNetwork]
Sizes = tuple[tuple[float, float], ...]  # degrees and metres

PERTURBATIONS = ((0.41, 0.145), (0.10, 0.054))  # degrees and metres, RMS over pairs
REAL_PERTURBATIONS = ((0.41, 0.149),)
VOXEL_M, MAX_DISTANCE_M = 0.2, 1.0  # small_gicp's thinning and largest distance of a match


def gicp_steps(sequence: Sequence) -> Array:
    """Return ``T_k_k1`` ``(N, 4, 4)`` by GICP between full scans, started from the recording's own reference."""
    assert sequence.reference is not None
    steps, last = [], None
    for k in range(len(sequence)):
        points = prepare(sequence[k].scan).points.astype(np.float64)
        cloud, tree = small_gicp.preprocess_points(points, downsampling_resolution=VOXEL_M, num_threads=2)
        if last is not None:
            start = se3.between(sequence.reference.poses[k - 1], sequence.reference.poses[k])
            found = small_gicp.align(
                last[0], cloud, last[1], start, registration_type="GICP", max_correspondence_distance=MAX_DISTANCE_M,
                num_threads=2,
            )  # fmt: skip
            steps.append(np.asarray(found.T_target_source))
        last = cloud, tree
    return np.array(steps)


def untrained(settings: NetworkSettings) -> Networks:
    """Return networks of these settings as training starts with them, also with twice the registration steps."""
    out = {}
    for name, steps in (("untrained", 1), ("untrained, twice the steps", 2)):
        torch.manual_seed(0)
        network = OdometryNetwork(replace(settings, projective_steps=steps * settings.projective_steps))
        if steps == 1 or settings.projective_steps:
            out[name] = network.eval()
    return out


def accuracy_rows(networks: Networks, shard: Shard, reference: Array, perturbations: Sizes) -> Iterator[Row]:
    for (rotation_deg, translation_m), (name, network) in itertools.product(perturbations, networks.items()):
        figures = errors_by_step(network, shard, reference, with_errors(reference, rotation_deg, translation_m))
        cells = [f"{100 * metres:.2f} cm / {degrees:.3f}°" for degrees, metres in figures]
        yield {
            "recording": shard.info.name,
            "weights": name,
            "initial error": cells[0],
            "after one step": cells[1],
            "after all steps": cells[-1],
        }


def adapted(weights: Weights, shard: Shard, changes: Path | None = None) -> OdometryNetwork:
    """Return the network trained further on a recording, without labels; a file may change the recipe."""
    recipe = choose_recipe(weights_recipe=weights.recipe, file=changes)
    with tempfile.TemporaryDirectory() as folder:
        start = weights.fitting(recipe.network)
        return train(recipe, Pairs([shard], recipe.network), folder, start=start, options=RunOptions("cpu")).eval()


def stages(network: OdometryNetwork, sequence: Sequence) -> dict[str, Callable[[], object]]:
    """Return the stages of a scan as functions, and registration by small_gicp for comparison."""
    last, current = (prepare(sequence[k].scan).points for k in (0, 1))
    geometry, threads = network.settings.geometry, torch.get_num_threads()
    maps = [torch.from_numpy(vertex_map(points, geometry))[None] for points in (last, current)]
    seen = [network.encode(one) for one in maps]
    start = torch.eye(4)[None]
    imu, velocity, dt = torch.zeros(1, network.settings.imu_samples, 6), torch.zeros(1, 3), torch.full((1,), 0.1)

    def maps_and_network() -> None:
        vertices = torch.from_numpy(vertex_map(current, geometry))[None]
        assert network.imu_network is not None
        pose = network.imu_network(imu, velocity, dt)
        network.refine_encoded(seen[0], network.encode(vertices), pose)

    def registration() -> None:
        target = small_gicp.preprocess_points(last.astype(np.float64), VOXEL_M, num_threads=threads)
        source = small_gicp.preprocess_points(current.astype(np.float64), VOXEL_M, num_threads=threads)
        small_gicp.align(target[0], source[0], target[1], num_threads=threads)

    return {
        "vertex map": lambda: vertex_map(current, geometry),
        "normal map, features": lambda: network.encode(maps[1]),
        "LSTMs": lambda: network.imu_network(imu, velocity, dt),  # type: ignore[misc]
        "residual": lambda: network.refine_encoded(seen[0], seen[1], start),
        "both maps and network": maps_and_network,
        "small_gicp, both scans": registration,
    }


@torch.no_grad()
def time_rows(network: OdometryNetwork, sequence: Sequence, threads: int, runs: int = 30) -> list[Row]:
    """Return median wall-clock and processor milliseconds of each stage, and the ratio to small_gicp's.

    The stages take turns. Other load on the machine lengthens wall-clock time; processor time includes the spinning of
    threads that wait for each other.
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
            "processor, relative to small_gicp": f"{median[1] / peer[1]:.2f}",
        }
        for name, median in medians.items()
    ]


def drift_rows(networks: Networks, shards: list[Shard]) -> Iterator[Row]:
    for shard, (name, network) in itertools.product(shards, networks.items()):
        driven = drive(network, shard)
        length = float(np.linalg.norm(driven.reference[:, :3, 3], axis=1).sum())
        (t_rel, r_rel), lstm = driven.drift or (None, None), step_errors(driven.initial, driven.reference)
        yield {
            "recording": shard.info.name,
            "weights": name,
            "length [m]": f"{length:.0f}",
            "t_rel [%]": tables.number(t_rel, 2),
            "r_rel [°/100 m]": tables.number(r_rel, 2),
            "error of the initial pose": f"{100 * lstm[1]:.1f} cm / {lstm[0]:.3f}°",
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", default="shipped", help="a file or the name of shipped weights")
    for name in ("--simulated", "--real", "--long"):
        parser.add_argument(name, type=Path, nargs="*", default=[], metavar="DRIVE")
    parser.add_argument("--adapt", action="store_true", help="train on each real recording, test on the others")
    parser.add_argument(
        "--iterations", type=int, default=0, metavar="N", help="ask for the residual N times (default: as trained)"
    )
    parser.add_argument("--time", action="store_true", help="measure the time of each stage")
    parser.add_argument("--cache", type=Path, default=Path("shards"), metavar="DIR", help="for shards")
    parser.add_argument("-o", "--out", type=Path, metavar="DIR", help="for front_end.json")
    options = parser.parse_args()
    weights = load_weights(weights_path(options.weights)).asked(options.iterations)
    networks, found = {"trained": weights.network(), **untrained(weights.recipe.network)}, {}

    def shards(paths: list[Path]) -> list[Shard]:
        return prepare_shards(paths, weights.recipe, DataOptions(options.cache)) if paths else []

    def show(title: str, rows: list[Row]) -> None:
        if rows:
            found[title] = rows
            print(f"\n{title}\n\n{tables.to_markdown(rows, ('recording', 'stage', 'weights'))}", flush=True)

    simulated = shards(options.simulated)
    show("Simulated drives", [r for s in simulated for r in accuracy_rows(networks, s, s.reference[1:], PERTURBATIONS)])
    real = [(open_sequence(path), s) for path, s in zip(options.real, shards(options.real), strict=True)]
    steps = {s.info.name: gicp_steps(sequence) for sequence, s in real}

    def real_rows(networks: Networks, tested: list[Shard]) -> list[Row]:
        return [r for s in tested for r in accuracy_rows(networks, s, steps[s.info.name], REAL_PERTURBATIONS)]

    show("Real recordings", real_rows(networks, [s for _, s in real]))
    for _, trained_on in real if options.adapt and len(real) > 1 else []:
        others = [s for _, s in real if s is not trained_on]
        show(f"Adapted to {trained_on.info.name}", real_rows({"adapted": adapted(weights, trained_on)}, others))
    show("Without a graph", list(drift_rows(networks, shards(options.long))))
    if options.time:
        first = (options.simulated + options.real + options.long)[0]
        show(
            "Time for each scan",
            [row for n in (1, 2) for row in time_rows(networks["trained"], open_sequence(first), n)],
        )
    if options.out:
        write_atomically(options.out / "front_end.json", json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()
