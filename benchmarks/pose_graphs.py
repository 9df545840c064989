"""Compare `PoseGraph` with bare GTSAM calls in one process: ``python benchmarks/pose_graphs.py FOLDER [NAME …]``.

FOLDER holds g2o files. GTSAM solves each from the file's initial values and from its own best initialisation (3-D:
chordal; 2-D: LAGO, which accepts diagonal noise only), by Levenberg-Marquardt and by Gauss-Newton. GTSAM's best result
is the one with the smallest error, or the faster of equal ones. Both are processor times of reading, initial values and
solving. ``--bad-starts`` replaces the initial values of sphere2500 and torus3D (or of the files named) by bad ones, and
prints the error reached relative to the best.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from hybridlio.core import se3
from hybridlio.graph import PoseGraph

_EQUAL = 1e-5  # relative difference of equal errors, GTSAM's own tolerance for convergence


@dataclass(frozen=True)
class Outcome:
    """The result of one method: final error, seconds in all, and seconds without reading."""

    name: str
    error: float
    total_s: float
    solve_s: float


def gtsam_alone(path: Path, is_3d: bool, start: str, optimiser: str = "LevenbergMarquardt") -> Outcome:
    """Solve a file with GTSAM, from the initial values ``given`` or from GTSAM's ``own`` initialisation."""
    begin = time.process_time()
    graph, values = gtsam.readG2o(str(path), is_3d)
    read_s = time.process_time() - begin
    first = min(values.keys())
    noise = gtsam.noiseModel.Isotropic.Sigma(6 if is_3d else 3, 1e-6)
    if is_3d:
        graph.add(gtsam.PriorFactorPose3(first, values.atPose3(first), noise))
    else:
        graph.add(gtsam.PriorFactorPose2(first, values.atPose2(first), noise))
    begin = time.process_time()
    if start == "own":
        values = gtsam.InitializePose3.initialize(graph) if is_3d else lago(graph)
    try:
        values = getattr(gtsam, f"{optimiser}Optimizer")(graph, values).optimize()
    except RuntimeError:  # Gauss-Newton has no damping
        return Outcome(f"gtsam, {start} start, {optimiser}", np.inf, np.inf, np.inf)
    solve_s = time.process_time() - begin
    return Outcome(f"gtsam, {start} start, {optimiser}", graph.error(values), read_s + solve_s, solve_s)


def lago(graph: gtsam.NonlinearFactorGraph) -> gtsam.Values:
    """Initialise a 2-D graph by LAGO, with the diagonals of its information matrices."""
    diagonal = gtsam.NonlinearFactorGraph()
    for k in range(graph.size()):
        factor: Any = graph.at(k)
        keys = factor.keys()
        if len(keys) == 2:
            sigmas = 1 / np.sqrt(np.diag(factor.noiseModel().information()))
            model = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
            diagonal.add(gtsam.BetweenFactorPose2(keys[0], keys[1], factor.measured(), model))
    first = gtsam.noiseModel.Diagonal.Sigmas(np.full(3, 1e-6))
    diagonal.add(gtsam.PriorFactorPose2(min(graph.keyVector()), gtsam.Pose2(), first))
    return gtsam.lago.initialize(diagonal)


def ours(path: Path) -> Outcome:
    begin = time.process_time()
    graph = PoseGraph.load(path)
    loaded = time.process_time()
    solution = graph.optimize()
    end = time.process_time()
    return Outcome("ours", solution.error, end - begin, end - loaded)


def fastest(outcomes: list[Outcome]) -> Outcome:
    return min(outcomes, key=lambda outcome: outcome.total_s)


def compare(path: Path, runs: int) -> None:
    is_3d = PoseGraph.load(path).dimension == 3
    ways = [(start, optimiser) for start in ("given", "own") for optimiser in ("LevenbergMarquardt", "GaussNewton")]
    # the methods take turns, so that other load on the machine affects all alike
    rounds = [([gtsam_alone(path, is_3d, *way) for way in ways], ours(path)) for _ in range(runs)]
    mine = fastest([one for _, one in rounds])
    alone = [fastest(list(column)) for column in zip(*(others for others, _ in rounds), strict=True)]
    given, own = (min(alone[k : k + 2], key=lambda one: one.error) for k in (0, 2))
    least_error = min(one.error for one in alone if np.isfinite(one.error))
    best = fastest([one for one in alone if one.error <= least_error * (1 + _EQUAL)])
    ratio, ratio_solve = mine.total_s / best.total_s, mine.solve_s / best.solve_s
    print(
        f"{path.stem:16s} {given.error:12.6g} {own.error:12.6g} {mine.error:12.6g} "
        f"{best.total_s:8.3f} {mine.total_s:8.3f} {ratio:6.2f} {ratio_solve:6.2f}",
        flush=True,
    )


def bad_starts(count: int, extent_m: float, seeds: int) -> dict[str, np.ndarray]:
    """Return initial poses by name: all at the identity, and random positions and attitudes by seed."""
    starts = {"identity": np.tile(np.eye(4), (count, 1, 1))}
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        positions = extent_m * rng.uniform(-0.5, 0.5, (count, 3))
        starts[f"random {seed}"] = se3.make(Rotation.random(count, rng).as_matrix(), positions)
    return starts


def compare_bad_starts(path: Path, seeds: int) -> None:
    best = min(gtsam_alone(path, True, "given").error, gtsam_alone(path, True, "own").error, ours(path).error)
    graph = PoseGraph.load(path)
    extent_m = float(np.ptp([np.asarray(graph.initial(key))[:3, 3] for key in graph.keys], axis=0).max())
    for name, poses in bad_starts(len(graph), extent_m, seeds).items():
        for key, pose in zip(graph.keys, poses, strict=True):
            graph.set_initial(key, pose)
        for initial in ("auto", "chordal", "given"):
            begin = time.process_time()
            ratio = graph.optimize(initial=initial).error / best
            spent_s = time.process_time() - begin
            print(f"{path.stem:16s} {name:10s} {initial:8s} {best:12.6g} {ratio:12.8f} {spent_s:8.2f}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="of g2o files")
    parser.add_argument("names", nargs="*", metavar="NAME", help="files without .g2o (default: all)")
    parser.add_argument("--runs", type=int, default=3, help="repeats, or seeds of bad starts (default: %(default)s)")
    parser.add_argument("--bad-starts", action="store_true", help="start from bad initial values")
    options = parser.parse_args()
    if options.bad_starts:
        print(f"{'':16s} {'start':10s} {'initial':8s} {'best error':>12s} {'reached/best':>12s} {'s':>8s}")
        for name in options.names or ("sphere2500", "torus3D"):
            compare_bad_starts(options.folder / f"{name}.g2o", options.runs)
        return
    paths = [options.folder / f"{name}.g2o" for name in options.names] or sorted(options.folder.glob("*.g2o"))
    print(
        f"{'errors and times':16s} {'gtsam given':>12s} {'gtsam own':>12s} {'ours':>12s} "
        f"{'gtsam s':>8s} {'ours s':>8s} {'ratio':>6s} {'solve':>6s}"
    )
    for path in paths:
        compare(path, options.runs)


if __name__ == "__main__":
    main()
