"""Graphs with landmarks end at the right minimum from odometry that has drifted far."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.graph import PoseGraph

# Of GTSAM 4.3's Levenberg-Marquardt on what its load2D reads, from its start, after 229 iterations.
GTSAMS_ERROR = 105_099.3
BEST_ERROR = 2339.22  # of iSAM2 pose by pose, then Gauss-Newton


def test_victoria_park_ends_far_below_gtsams_own_minimum(shared_data: Path):
    graph = PoseGraph.load(shared_data / "pose_graphs" / "victoria_park.txt")
    assert (len(graph), len(graph.landmarks), len(graph.factors)) == (6969, 151, 10608)
    assert not graph.load_report
    solution = graph.optimize()
    assert solution.converged
    assert solution.error < GTSAMS_ERROR
    assert solution.error == pytest.approx(BEST_ERROR, rel=1e-4)


def test_a_drifted_loop_with_landmarks_is_closed(rng):
    graph, truth, sigmas = PoseGraph(2), np.eye(4), (0.02, 0.02, 0.02)
    graph.add_pose(0, np.eye(4))
    graph.fix(0)
    points, true_poses = rng.uniform(-10, 50, size=(60, 2)), []
    for k in range(400):
        if k:
            step = se3.exp([0, 0, 2 * np.pi / 200, 0.6, 0, 0])
            truth = truth @ step
            noise = np.zeros(6)
            noise[2:5] = 0.02 * rng.normal(size=3) + [0.01, 0, 0]  # a biased gyroscope
            graph.add_between(k - 1, k, step @ se3.exp(noise), sigmas=sigmas)
        true_poses.append(truth)
        for m, point in enumerate(points):
            local = truth[:2, :2].T @ (point - truth[:2, 3])
            if np.linalg.norm(local) < 12:
                graph.add_point_observation(k, (11, m), local + 0.05 * rng.normal(size=2), sigmas=0.05)
    seen = []
    solution = graph.optimize(progress=lambda *event: seen.append(event[:2]))
    assert ("growing", 50) in seen
    np.testing.assert_allclose(
        solution.poses[:, :2, 3], np.array(true_poses)[:, :2, 3], atol=0.5
    )  # of a drift of tens of metres


def test_a_start_that_fits_is_kept():
    graph = PoseGraph(2)
    graph.add_prior(0, np.eye(4), sigmas=0.1)
    graph.add_point_observation(0, 5, [1.0, 2.0], sigmas=0.1)
    seen = []
    graph.optimize(progress=lambda *event: seen.append(event[0]))
    assert "growing" not in seen
