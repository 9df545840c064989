"""Whatever is done with a graph, it holds what was given, errors change nothing, and all solvers agree."""

from __future__ import annotations

import threading

import graph_machine
import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.graph import PoseGraph


def test_random_use_of_a_graph_keeps_its_promises():
    before = graph_machine.steps["steps"]
    graph_machine.run(seed=1, examples=120)
    assert graph_machine.steps["steps"] - before >= 5000


@pytest.mark.parametrize("backend", ["incremental", "fixed-lag"])
def test_a_replay_that_has_not_settled_is_not_called_converged(backend):
    """A history in which roll and pitch are nearly free: iSAM2 fails at its first estimate, then jumps by metres."""
    state = graph_machine.GraphMachine()
    state.start(dimension=3)
    state.merge(seed=0)
    state.remove_pose(key=0)
    state.add_other(key=0, kind="custom", seed=94)
    state.add_other(key=0, kind="heading", seed=247)
    state.add_pose(is_placed=False, key=0, seed=216007)
    state.remove_pose(key=0)
    state.add_other(key=0, kind="gps", seed=0)
    state.add_between(i=0, j=0, robust=None, seed=0)
    solution = state.graph.optimize(backend)
    assert solution.error > 100 * state.graph.optimize().error
    assert not solution.converged


def test_two_threads_solve_two_graphs():
    def solve(found: list[object], noise: float) -> None:
        rng, graph = np.random.default_rng(1), PoseGraph()
        graph.add_prior(0, np.eye(4), sigmas=1e-2)
        solver = graph.online()
        for k in range(150):
            graph.add_between(k, k + 1, se3.exp(rng.normal(0, noise, 6)), sigmas=0.1)
            solver.update()
        found.append((graph.optimize().poses, solver.poses))

    alone: list[object] = []
    solve(alone, 0.1)
    together: list[list[object]] = [[], [], []]
    threads = [
        threading.Thread(target=solve, args=(found, noise))
        for found, noise in zip(together, (0.1, 0.2, 0.1), strict=True)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for found in together[::2]:
        np.testing.assert_array_equal(found[0][0], alone[0][0])
        np.testing.assert_array_equal(found[0][1], alone[0][1])
