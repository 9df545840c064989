"""Solve a simulated city by `batch`, and measure time and memory: ``python benchmarks/pose_graphs_city.py POSES …``.

A vehicle drives at random through a square grid of streets with an intersection every ten steps of 1 m, and closes a
loop at every fifth pose, on average, to a pose at the same place. The city grows with the drive, so that each place is
visited about five times.
"""

from __future__ import annotations

import argparse
import resource
import time

import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.graph import PoseGraph
from hybridlio.graph.model.graph_data import GraphData

_BLOCK = 10  # steps of 1 m between intersections
_VISITS = 5  # of each place, on average
_LOOP_SHARE = 0.2  # loops for each pose
_SIGMAS = np.array([2e-3, 0.02, 0.02])  # of every measurement: rad, m, m


def drive(count: int, rng: np.random.Generator) -> Array:
    """Return poses ``(count, 3)`` x, y, θ of a random drive that turns back at the city's border."""
    half = round(np.sqrt(count / (8 * _BLOCK * _VISITS))) * _BLOCK  # a square of side s has 2 s² / block of street
    turns = rng.choice([0, 1, -1], count // _BLOCK + 1)
    ahead = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
    corners, headings, at, heading = [], [], np.zeros(2, dtype=np.int64), 0
    for turn in turns.tolist():
        heading = (heading + turn) % 4
        while np.abs(at + _BLOCK * ahead[heading]).max() > half:
            heading = (heading + 1) % 4
        corners.append(at)
        headings.append(heading)
        at = at + _BLOCK * ahead[heading]
    block, step = np.divmod(np.arange(count), _BLOCK)
    xy = np.array(corners)[block] + step[:, None] * ahead[np.array(headings)[block]]
    return np.column_stack([xy, np.pi / 2 * np.array(headings)[block]])


def loops(truth: Array, rng: np.random.Generator) -> Array:
    """Return pairs ``(K, 2)`` of poses at the same place, the earlier one first."""
    cell = np.unique(np.round(truth[:, :2]).astype(np.int64), axis=0, return_inverse=True)[1].ravel()
    order = np.lexsort((np.arange(len(cell)), cell))
    again = np.flatnonzero(cell[order][1:] == cell[order][:-1])
    pairs = np.column_stack([order[again], order[again + 1]])
    pairs = pairs[pairs[:, 1] - pairs[:, 0] > 1]
    chosen = rng.choice(len(pairs), min(round(_LOOP_SHARE * len(truth)), len(pairs)), replace=False)
    return np.asarray(pairs[np.sort(chosen)])


def measured(truth: Array, ends: Array, rng: np.random.Generator) -> Array:
    """Return noisy relative poses ``(K, 3)`` x, y, θ."""
    a, b = truth[ends[:, 0]], truth[ends[:, 1]]
    c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
    dx, dy = (b - a)[:, 0], (b - a)[:, 1]
    exact = np.column_stack([c * dx + s * dy, c * dy - s * dx, b[:, 2] - a[:, 2]])
    noisy = exact + _SIGMAS[[1, 2, 0]] * rng.standard_normal(exact.shape)
    noisy[:, 2] = np.arctan2(np.sin(noisy[:, 2]), np.cos(noisy[:, 2]))
    return noisy


def city(count: int, rng: np.random.Generator) -> tuple[PoseGraph, Array]:
    """Return the graph and its true poses ``(count, 3)`` x, y, θ."""
    truth = drive(count, rng)
    ends = np.vstack([np.column_stack([np.arange(count - 1), np.arange(1, count)]), loops(truth, rng)])
    graph = PoseGraph(dimension=2)
    data: GraphData = graph._data
    data.add_poses(range(count), np.full((count, 3), np.nan))
    data.set_initial(0, truth[0])
    data.fix(0)
    information = np.tile(np.diag(_SIGMAS**-2.0), (len(ends), 1, 1))
    data.add_edges(np.arange(len(ends)), ends, measured(truth, ends, rng), information, {})
    return graph, truth


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("poses", type=int, nargs="+", help="of the drive; memory is the process's peak so far")
    for count in parser.parse_args().poses:
        graph, truth = city(count, np.random.default_rng(0))
        begin = time.process_time()
        solution = graph.optimize()
        spent_s = time.process_time() - begin
        rmse_m = np.sqrt(((solution.coordinates[:, :2] - truth[:, :2]) ** 2).sum(axis=1).mean())
        peak_gib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        print(
            f"{count:9d} poses {len(graph.factors):9d} factors {spent_s:8.1f} s processor time {peak_gib:6.2f} GiB "
            f"{solution.iterations:3d} iterations, RMSE {rmse_m:.3f} m, error per factor "
            f"{solution.error / len(graph.factors):.3f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
