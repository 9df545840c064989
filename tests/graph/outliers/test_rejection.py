"""Graduated non-convexity rejects wrong loops, keeps correct ones and ends at the solution of the clean graph."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.errors import GraphError
from hybridlio.graph import PoseGraph
from hybridlio.graph.base.truncated_squares import chi2_bound
from hybridlio.graph.outliers import rejection


def laps(rng: np.random.Generator, dimension: int, count: int = 120, lap: int = 30) -> PoseGraph:
    """Return laps of a circle, with a loop closure to the previous lap at every other pose."""
    used = slice(0, 6) if dimension == 3 else slice(2, 5)
    sigmas = np.array([0.01, 0.01, 0.01, 0.05, 0.05, 0.05])

    def noisy(step: np.ndarray) -> np.ndarray:
        xi = np.zeros(6)
        xi[used] = (sigmas * rng.standard_normal(6))[used]
        return step @ se3.exp(xi)

    step = se3.exp([0, 0, 2 * np.pi / lap, 1, 0, 0])
    graph = PoseGraph(dimension)
    graph.add_prior(0, np.eye(4), sigmas=1e-3)
    for k in range(count - 1):
        graph.add_between(k, k + 1, noisy(step), sigmas=sigmas[used])
    for k in range(lap, count, 2):
        graph.add_between(k, k - lap, noisy(np.eye(4)), sigmas=sigmas[used])
    return graph


def add_wrong_loops(graph: PoseGraph, rng: np.random.Generator, share: float) -> set[int]:
    """Add loops between random poses that claim the relative pose of some correct loop; return their ids."""
    correct = [f for f in graph.factors.values() if f.kind == "between" and abs(f.keys[0] - f.keys[1]) > 1]
    truth = graph.optimize()
    wrong: set[int] = set()
    while len(wrong) < round(share * len(correct)):
        i, j = (int(k) for k in rng.choice(len(graph), 2, replace=False))
        copied = correct[rng.integers(len(correct))]
        measured = se3.between(truth.pose(copied.keys[0]), truth.pose(copied.keys[1]))
        if np.linalg.norm(truth.pose(i)[:3, 3] - truth.pose(j)[:3, 3]) > 3 and abs(i - j) > 1:
            wrong.add(graph.add_between(i, j, measured, information=copied.noise.information))
    return wrong


def rmse(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.sqrt(((a[:, :3, 3] - b[:, :3, 3]) ** 2).sum(axis=1).mean()))


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("share", [0.1, 0.4])
def test_wrong_loops_are_rejected(rng, dimension, share):
    graph = laps(rng, dimension)
    clean = graph.optimize()
    wrong = add_wrong_loops(graph, rng, share)
    spoilt, solution = graph.optimize(), graph.optimize("gnc")
    assert wrong <= solution.rejected
    assert len(solution.rejected - wrong) <= 2  # one correct loop in a hundred exceeds the bound
    assert rmse(solution.poses, clean.poses) < 0.05
    assert rmse(spoilt.poses, clean.poses) > 0.5
    assert all(solution.weight(number) == 0 for number in wrong)
    assert min(solution.chi2(number) for number in wrong) > chi2_bound(6 if dimension == 3 else 3)


def test_a_clean_graph_is_solved_as_in_batch(rng):
    graph = laps(rng, 3)
    batch, solution = graph.optimize(), graph.optimize("gnc")
    assert len(solution.rejected) <= 2
    assert rmse(solution.poses, batch.poses) < 0.01


def test_where_loops_show_that_noise_is_overstated_a_wrong_one_does_not_bend_the_map(rng):
    """It would cost less than its rejection at the stated noise, ten times that of the measurements."""
    graph = PoseGraph(2)
    graph.add_prior(0, np.eye(4), sigmas=1e-3)
    step, stated = se3.exp([0, 0, 0, 1, 0, 0]), np.array([0.01, 0.05, 0.05])

    def noisy(T):
        return T @ se3.exp(np.r_[0, 0, 0.1 * stated * rng.standard_normal(3), 0])

    for k in range(60):
        graph.add_between(k, k + 1, noisy(step), sigmas=stated)
    for k in range(4, 40):
        graph.add_between(k - 4, k, noisy(se3.exp([0, 0, 0, 4, 0, 0])), sigmas=stated)
    clean = graph.optimize()
    off = se3.exp([0, 0, 0, 14, 0, 0]) @ se3.exp([0, 0, 0, 0.7, 0, 0])  # 0.19 m is one deviation of the odometry
    wrong = graph.add_between(45, 59, off, sigmas=stated)
    solution = graph.optimize("gnc")
    assert solution.rejected == {wrong}
    assert rmse(solution.poses, clean.poses) < 1e-3


@pytest.mark.parametrize("times", [1, 100])
def test_one_search_is_enough_where_large_clusters_hold_the_map(rng, monkeypatch, times):
    """Whatever noise is stated; with a hundred times too much, wrong loops 3 m off are within the stated bound."""
    monkeypatch.setattr(rejection, "all_at_once", lambda *_: pytest.fail("searched again"))
    graph = laps(rng, 3, count=200)
    clean, wrong = graph.optimize(), add_wrong_loops(graph, rng, 0.2)
    for number, factor in graph.factors.items():
        if factor.kind == "between":
            changed = graph.set_noise(number, information=factor.noise.information / times**2)
            wrong = wrong - {number} | {changed} if number in wrong else wrong
    solution = graph.optimize("gnc")
    assert wrong <= solution.rejected
    assert len(solution.rejected - wrong) <= 2
    assert not solution.doubtful
    assert rmse(solution.poses, clean.poses) < 0.05


def test_a_loop_that_alone_joins_a_part_is_kept(rng):
    graph = laps(rng, 3, count=40)
    graph.add_between(5, 100, se3.exp([0, 0, 1, 2, 0, 0]), sigmas=0.1)
    solution = graph.optimize("gnc")
    np.testing.assert_allclose(solution.pose(5) @ se3.exp([0, 0, 1, 2, 0, 0]), solution.pose(100), atol=1e-4)


def test_contradicting_loops_that_alone_join_a_part_are_refused(rng):
    graph = laps(rng, 3, count=40)
    graph.add_between(5, 100, se3.exp([0, 0, 0, 50, 0, 0]), sigmas=0.01)
    graph.add_between(5, 100, se3.exp([0, 0, 0, -50, 0, 0]), sigmas=0.01)
    with pytest.raises(GraphError, match="pose 100"):
        graph.optimize("gnc")


def test_a_tenth_of_wrong_loops_in_a_recorded_drive_is_rejected(shared_data: Path, rng):
    graph = PoseGraph.load(shared_data / "pose_graphs" / "kitti_00.g2o")
    clean = graph.optimize()
    wrong = add_wrong_loops(graph, rng, 0.1)
    solution = graph.optimize("gnc")
    assert solution.rejected == wrong
    spread = rmse(clean.poses, np.tile(clean.poses.mean(axis=0), (len(clean.poses), 1, 1)))
    assert rmse(solution.poses, clean.poses) < 0.01 * spread
