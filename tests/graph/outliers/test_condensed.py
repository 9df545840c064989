"""A condensed graph has the least cost of the whole graph, and its solution expands to the whole graph's."""

from __future__ import annotations

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.graph import PoseGraph
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.edge_arrays import edges_of
from hybridlio.graph.outliers.condensed import Condensed, condense
from hybridlio.graph.outliers.descents import descent
from hybridlio.graph.outliers.loop_support import GraphOdometry
from hybridlio.graph.outliers.rejection import odometry_start
from hybridlio.graph.outliers.weighted_solver import WeightedSolver
from hybridlio.graph.solve.settings import silent


def drive(rng: np.random.Generator, dimension: int) -> PoseGraph:
    """Return 90 noisy steps along a circle with four loops, one step measured backwards and one measured twice."""
    used = slice(0, 6) if dimension == 3 else slice(2, 5)
    sigmas = np.array([2e-3, 2e-3, 2e-3, 0.02, 0.02, 0.02])
    step = se3.exp([0, 0, 2 * np.pi / 30, 1, 0, 0])

    def noisy(T: np.ndarray) -> np.ndarray:
        xi = np.zeros(6)
        xi[used] = (sigmas * rng.standard_normal(6))[used]
        return T @ se3.exp(xi)

    graph = PoseGraph(dimension)
    graph.add_prior(0, np.eye(4), sigmas=1e-3)
    for k in range(90):
        if k == 20:
            graph.add_pose(k + 1)
            graph.add_between(k + 1, k, noisy(se3.inverse(step)), sigmas=sigmas[used])
        else:
            graph.add_between(k, k + 1, noisy(step), sigmas=sigmas[used])
    graph.add_between(40, 41, noisy(step), sigmas=sigmas[used])
    for i, j in ((2, 32), (10, 70), (35, 65), (55, 85)):
        graph.add_between(i, j, noisy(np.linalg.matrix_power(step, j - i)), sigmas=sigmas[used])
    return graph


def condensed(graph: PoseGraph) -> tuple[Condensed, WeightedSolver, WeightedSolver]:
    data = graph._data
    edges = edges_of(data)
    loops, odometry = edges.where(~edges.consecutive), edges.where(edges.consecutive)
    chain = GraphOdometry(data, odometry, co.to_matrices(odometry_start(data)))
    trusted = data.copy(without=loops.ids.tolist())
    small = condense(trusted, loops, odometry, chain)
    return (
        small,
        WeightedSolver(descent(small.trusted, small.loops), small.odometry, 20.0, silent),
        WeightedSolver(descent(trusted, loops), odometry, 20.0, silent),
    )


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_least_cost_is_that_of_the_whole_graph(rng, dimension):
    graph = drive(rng, dimension)
    small, on_small, on_whole = condensed(graph)
    assert len(small.kept) < 16  # ends of loops and of the drive, and both poses of the step that was measured twice
    start, everything = odometry_start(graph._data), np.ones(4)
    least_small = on_small.solve(on_small.values(start[small.kept]), everything, 20)
    least_whole = on_whole.solve(on_whole.values(start), everything, 20)
    assert on_small.cost(least_small) == pytest.approx(on_whole.cost(least_whole), rel=1e-2)
    np.testing.assert_allclose(on_small.poses(least_small), on_whole.poses(least_whole)[small.kept], atol=5e-3)


@pytest.mark.parametrize("dimension", [2, 3])
def test_expanding_keeps_the_odometry_where_no_end_has_moved(rng, dimension):
    graph = drive(rng, dimension)
    small, _, _ = condensed(graph)
    start = odometry_start(graph._data)
    np.testing.assert_allclose(co.to_matrices(small.expand(start[small.kept])), co.to_matrices(start), atol=1e-9)


def test_an_expanded_solution_is_near_that_of_the_whole_graph(rng):
    graph = drive(rng, 3)
    small, _, _ = condensed(graph)
    solved = graph.optimize()
    expanded = small.expand(solved.coordinates[small.kept])
    moved = np.linalg.norm(co.to_matrices(expanded)[:, :3, 3] - solved.poses[:, :3, 3], axis=1)
    drifted = np.linalg.norm(co.to_matrices(odometry_start(graph._data))[:, :3, 3] - solved.poses[:, :3, 3], axis=1)
    assert moved.max() < 0.2 * drifted.max()
