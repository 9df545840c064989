"""Solve a g2o file: read, optimise, print the error, and write the result beside it.

python examples/solve_g2o.py FILE.g2o [SOLVER]      # batch, or gnc if some loops may be wrong

Without a file, it creates one: a noisy spiral in the plane.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np

from hybridlio.core import se3
from hybridlio.graph import PoseGraph


def make_file(folder: Path) -> Path:
    """Write a file that has edges only, like many g2o files, so that initial values must be computed."""
    rng = np.random.default_rng(2)
    sigmas = np.array([0.01, 0.03, 0.03])  # in the plane: heading, x, y
    poses = [se3.exp([0, 0, 0.3 * k, 0, 0, 0]) @ se3.make(np.eye(3), [1 + 0.02 * k, 0, 0]) for k in range(100)]
    graph = PoseGraph(dimension=2)
    graph.add_pose(0, np.eye(4))
    graph.fix(0)
    pairs = [(k, k + 1) for k in range(99)] + [(k, k + 21) for k in range(0, 79, 3)]
    for i, j in pairs:
        noise = se3.exp([0, 0, *(sigmas * rng.standard_normal(3)), 0])
        graph.add_between(i, j, se3.between(poses[i], poses[j]) @ noise, sigmas=sigmas)
    path = folder / "spiral.g2o"
    graph.save(path)
    return path


def main(source: str | None = None, solver: str = "batch") -> None:
    given = Path(source or tempfile.mkdtemp(prefix="hybridlio-"))
    path = make_file(given) if given.is_dir() else given
    graph = PoseGraph.load(path)
    solution = graph.optimize("gnc" if solver == "gnc" else "batch")
    worst = max(solution.all_chi2().items(), key=lambda item: item[1])
    print(f"{path.name}: {len(graph)} poses, {len(graph.factors)} factors in {graph.dimension} dimensions")
    print(f"error {solution.error_before:.6g} -> {solution.error:.6g} in {solution.iterations} iterations")
    print(f"worst factor: {graph.factors[worst[0]].label}, chi2 {worst[1]:.2f}; rejected: {len(solution.rejected)}")
    solved = path.with_name(f"{path.stem}-solved.g2o")
    graph.save(solved, solution)
    print(f"wrote {solved}")


if __name__ == "__main__":
    main(*sys.argv[1:])
