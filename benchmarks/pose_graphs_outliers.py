"""Solve graphs with wrong loop closures by `gnc`: ``python benchmarks/pose_graphs_outliers.py FOLDER [NAME …]``.

FOLDER holds g2o files. Wrong loops join random poses, with the measurement and the noise of a random right loop; in
groups of five, they join five consecutive pairs of poses and agree with one another within their noise. The error is
the RMSE of positions against the solution of the clean graph, in percent of the spread of its positions.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.graph import OnlineSolver, PoseGraph
from hybridlio.graph.model.coordinates import to_matrices
from hybridlio.graph.model.measurements import Factor

_GOOD_PERCENT = 1.0  # of the spread, from which a result counts as right


def _length(factor: Factor) -> int:
    i, j = factor.keys
    assert isinstance(i, int)
    assert isinstance(j, int)
    return abs(i - j)


def add_wrong_loops(graph: PoseGraph, poses: Array, share: float, group: int, seed: int) -> set[int]:
    """Add wrong loops, a share of the right ones, in groups; return their ids."""
    rng, keys = np.random.default_rng(seed), graph.keys
    if len(keys) < 3 * group:
        raise SystemExit(f"{len(keys)} poses are too few for groups of {group} wrong loops")
    between = [factor for factor in graph.factors.values() if factor.kind == "between"]
    loops = [factor for factor in between if _length(factor) != 1]
    wrong: set[int] = set()
    while len(wrong) < round(share * len(loops)):
        i, j = (int(k) for k in rng.choice(len(keys) - group, 2, replace=False))
        copied = loops[rng.integers(len(loops))]
        if abs(i - j) <= group:
            continue
        T_i_j, noise = to_matrices(copied.measured[None])[0], copied.noise
        assert noise is not None
        for k in range(group):
            step = se3.inverse(se3.between(poses[i], poses[i + k])) @ T_i_j @ se3.between(poses[j], poses[j + k])
            step = step @ se3.exp(_error(rng, noise.covariance)) if k else step
            wrong.add(graph.add_between(keys[i + k], keys[j + k], step, information=noise.information))
    return wrong


def _error(rng: np.random.Generator, covariance: Array) -> Array:
    xi = rng.multivariate_normal(np.zeros(len(covariance)), covariance)
    return xi if len(xi) == 6 else np.r_[0, 0, xi, 0]


def grown(graph: PoseGraph) -> OnlineSolver:
    """Return a solver that tests outliers by ``gnc``, after the graph has grown pose by pose."""
    order = {key: k for k, key in enumerate(graph.keys)}
    complete: list[list[Factor]] = [[] for _ in order]
    for factor in graph.factors.values():
        complete[max(order[key] for key in factor.keys)].append(factor)
    growing = PoseGraph(graph.dimension)
    solver = growing.online(outliers="gnc")
    for key, factors in zip(graph.keys, complete, strict=True):
        growing.add_pose(key, graph.initial(key))
        if key in graph.fixed:
            growing.fix(key)
        for factor in factors:
            growing._data.add_factor(factor)
        solver.update()
    solver.update()
    return solver


def run(path: Path, share: float, group: int, seeds: range, online: bool) -> None:
    clean = PoseGraph.load(path).optimize().poses
    spread = np.sqrt(((clean[:, :3, 3] - clean[:, :3, 3].mean(axis=0)) ** 2).sum(axis=1).mean())
    errors, doubtful, spent_s = [], [], []
    for seed in seeds:
        graph = PoseGraph.load(path)
        add_wrong_loops(graph, clean, share, group, seed)
        begin = time.process_time()
        solution = grown(graph) if online else graph.optimize("gnc")
        spent_s.append(time.process_time() - begin)
        rmse = np.sqrt(((solution.poses[:, :3, 3] - clean[:, :3, 3]) ** 2).sum(axis=1).mean())
        errors.append(100 * rmse / spread)
        doubtful.append(bool(solution.doubtful))
    right = np.array(errors) < _GOOD_PERCENT
    silent = int((~right & ~np.array(doubtful)).sum())
    print(
        f"{path.stem:20s} {100 * share:3.0f} % {group:5d} {len(seeds):5d} "
        f"{right.sum():5d} {silent:13d} {sum(doubtful):8d} "
        f"{np.median(errors):8.3f} {max(errors):8.3f} {np.median(spent_s):6.1f}",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="of g2o files")
    parser.add_argument("names", nargs="*", metavar="NAME", help="files without .g2o (default: all)")
    parser.add_argument("--seeds", type=int, default=10, help="runs of each kind (default: %(default)s)")
    parser.add_argument("--first-seed", type=int, default=0, help="of the runs (default: %(default)s)")
    parser.add_argument("--shares", type=float, nargs="+", default=[0.1, 0.3], help="of wrong loops")
    parser.add_argument("--groups", type=int, nargs="+", default=[1, 5], help="wrong loops that agree")
    parser.add_argument("--online", action="store_true", help="pose by pose, by an online solver")
    options = parser.parse_args()
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    paths = [options.folder / f"{name}.g2o" for name in options.names] or sorted(options.folder.glob("*.g2o"))
    print(
        f"{'':20s} {'wrong':>5s} {'group':>5s} {'seeds':>5s} {'right':>5s} {'wrong, silent':>13s} {'doubtful':>8s} "
        f"{'median %':>8s} {'worst %':>8s} {'CPU s':>6s}"
    )
    for path in paths:
        for share in options.shares:
            for group in options.groups:
                run(path, share, group, seeds, options.online)


if __name__ == "__main__":
    main()
