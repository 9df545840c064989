"""Wrong loops in worlds where odometry drifts by more than the distance between places."""

from __future__ import annotations

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.graph import PoseGraph
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.edge_arrays import edges_of
from hybridlio.graph.outliers.loop_support import GraphOdometry, loop_support
from hybridlio.graph.outliers.rejection import loop_bound, odometry_start

SIGMAS = np.array([0.03, 0.05, 0.05])  # rad, m, m: after 400 steps of 1 m odometry is 10 m off
STATED = 5 * SIGMAS


def city(rng: np.random.Generator, count: int = 400, blocks: int = 5) -> PoseGraph:
    """Return a random walk through a grid of streets of 4 m, with loops to earlier visits; noise is overstated."""
    T, at, visits = [np.eye(4)], np.eye(4), {}
    for k in range(1, count):
        turn = 0.0
        if k % 4 == 0:
            x, y = at[:2, 3] + 4 * at[:2, 0]
            ahead = max(abs(x), abs(y)) <= 4 * blocks / 2
            turn = rng.choice([0, np.pi / 2, -np.pi / 2]) if ahead else np.pi / 2
        at = at @ se3.exp([0, 0, turn, 0, 0, 0]) @ se3.exp([0, 0, 0, 1, 0, 0])
        T.append(at)
    graph = PoseGraph(dimension=2)
    graph.add_prior(0, np.eye(4), sigmas=1e-3)

    def measure(i: int, j: int) -> None:
        xi = np.zeros(6)
        xi[2:5] = SIGMAS * rng.standard_normal(3)
        graph.add_between(i, j, se3.between(T[i], T[j]) @ se3.exp(xi), sigmas=STATED)

    for k in range(count - 1):
        measure(k, k + 1)
    for k in range(count):
        cell = tuple(np.round(T[k][:2, 3]).astype(int))
        if cell in visits and k - visits[cell] > 10:
            measure(visits[cell], k)
        visits.setdefault(cell, k)
    return graph


def add_groups_of_five(graph: PoseGraph, rng: np.random.Generator, share: float) -> set[int]:
    """Add wrong loops in groups of five that agree among themselves."""
    T, wrong = graph.optimize().poses, set()
    loops = sum(abs(f.keys[0] - f.keys[-1]) > 1 for f in graph.factors.values())
    while len(wrong) < share * loops:
        i, j = (int(k) for k in rng.choice(len(graph) - 5, 2, replace=False))
        if abs(i - j) > 10 and np.linalg.norm(T[i][:3, 3] - T[j][:3, 3]) > 3:
            for k in range(5):
                step = se3.inverse(se3.between(T[i], T[i + k])) @ se3.between(T[j], T[j + k])
                wrong.add(graph.add_between(i + k, j + k, step, sigmas=STATED))
    return wrong


def percent_of_spread(poses: np.ndarray, clean: np.ndarray) -> float:
    error = ((poses[:, :3, 3] - clean[:, :3, 3]) ** 2).sum(axis=1).mean()
    spread = ((clean[:, :3, 3] - clean[:, :3, 3].mean(axis=0)) ** 2).sum(axis=1).mean()
    return float(100 * np.sqrt(error / spread))


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_groups_of_wrong_loops_that_agree_do_not_move_the_map(rng, share):
    graph = city(rng)
    clean = graph.optimize().poses
    wrong = add_groups_of_five(graph, rng, share)
    solution = graph.optimize("gnc")
    assert wrong <= solution.rejected
    assert percent_of_spread(solution.poses, clean) < 1
    assert percent_of_spread(graph.optimize().poses, clean) > 10
    assert not solution.doubtful


def test_neighbours_tell_overstated_noise_and_confirm_right_loops_alone(rng):
    graph = city(rng)
    wrong = [graph.add_between(i, 399 - i, np.eye(4), sigmas=STATED) for i in range(0, 150, 15)]
    edges = edges_of(graph._data)
    loops, odometry = edges.where(~edges.consecutive), edges.where(edges.consecutive)
    along = co.to_matrices(odometry_start(graph._data))
    support = loop_support(loops, GraphOdometry(graph._data, odometry, along), loop_bound(3, len(loops.i)))
    assert 1 / 25 < support.scale < 4 / 25 * 2  # noise is stated five times too large; the margin is four
    is_wrong = np.isin(loops.ids, wrong)
    assert not support.supported[is_wrong].any()
    assert support.supported[~is_wrong].mean() > 0.9


def test_a_graph_whose_loops_contradict_each_other_is_doubtful(rng):
    graph = city(rng, count=120)
    for _ in range(200):
        i, j = (int(k) for k in rng.choice(120, 2, replace=False))
        if abs(i - j) > 1:
            graph.add_between(i, j, np.eye(4), sigmas=SIGMAS)
    solution = graph.optimize("gnc")
    assert any("rejected" in reason for reason in solution.doubtful)
    assert "doubtful" in repr(solution)
