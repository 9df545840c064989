"""Build a pose graph by hand: a walk around a square with a loop closure and a wrong loop, which is rejected.

python examples/pose_graph_by_hand.py [FOLDER]
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np

from hybridlio.core import se3
from hybridlio.graph import PoseGraph

SIDES, STEPS = 4, 10
SIGMAS = np.array([0.002, 0.002, 0.01, 0.05, 0.05, 0.02])  # of each step in rad and m, rotation first


def main(folder: str | None = None, *_: str) -> None:
    rng = np.random.default_rng(1)
    straight, corner = se3.exp([0, 0, 0, 1.0, 0, 0]), se3.exp([0, 0, np.pi / 2, 0, 0, 0])
    graph = PoseGraph()
    graph.add_prior(0, np.eye(4), sigmas=(1e-3,) * 6)  # the start
    truth = [np.eye(4)]
    for k in range(SIDES * STEPS):
        T_k_k1 = straight @ corner if k % STEPS == STEPS - 1 else straight
        truth.append(truth[-1] @ T_k_k1)
        graph.add_between(k, k + 1, T_k_k1 @ se3.exp(SIGMAS * rng.standard_normal(6)), sigmas=SIGMAS)
    last = SIDES * STEPS
    alone = graph.optimize()

    graph.add_between(last, 0, np.eye(4), sigmas=SIGMAS)  # loop closure: the last pose is at the start
    wrong = graph.add_between(25, 3, np.eye(4), sigmas=SIGMAS)  # a wrong loop: another place that looks the same
    solution = graph.optimize("gnc")

    for name, answer in (("odometry alone", alone), ("with the loop", solution)):
        error_m = np.linalg.norm(answer.pose(last)[:3, 3] - truth[last][:3, 3])
        sigma_m = np.sqrt(answer.covariance(last)[3:, 3:].trace())
        print(f"{name}: error of the last position {error_m:.3f} m, standard deviation {sigma_m:.3f} m")
    print(f"rejected factors: {sorted(solution.rejected)}; only the wrong loop: {solution.rejected == {wrong}}")
    path = Path(folder or tempfile.mkdtemp(prefix="hybridlio-")) / "square.g2o"
    graph.save(path, solution)
    print(f"wrote {path}")


if __name__ == "__main__":
    main(*sys.argv[1:])
