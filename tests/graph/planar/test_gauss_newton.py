"""Planar graphs are solved as GTSAM solves them: same errors, same optimum, the precision of QR on long chains."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.graph import PoseGraph
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.planar.gauss_newton import PlanarGaussNewton, planar_edges, solves
from hybridlio.graph.solve.builder import Builder


def planar_step(x: float, y: float, heading: float) -> np.ndarray:
    return co.to_matrices(np.array([[x, y, heading]]))[0]


def drifting_graph(rng: np.random.Generator, count: int = 80) -> PoseGraph:
    """Return laps of a circle with loops, priors, doubled edges and correlated noise; poses start where they are."""
    graph, steps = PoseGraph(2), [planar_step(1.0, 0.1, 0.3) @ _noise(rng) for _ in range(count - 1)]
    pose = np.eye(4)
    for k in range(count):
        graph.add_pose(k, pose @ _noise(rng))
        pose = pose @ steps[k] if k < count - 1 else pose
    A = rng.normal(size=(3, 3))
    for k, step in enumerate(steps):
        graph.add_between(k, k + 1, step, information=100 * (A @ A.T + np.eye(3)))
    for k in range(0, count - 21, 7):
        graph.add_between(k + 21, k, planar_step(0.2, 0.1, -0.1) @ _noise(rng), sigmas=(0.1, 0.2, 0.3))
        graph.add_between(k, k + 21, _noise(rng), np.diag([0.04, 0.01, 0.02]))
    graph.add_prior(3, np.eye(4), sigmas=(0.1, 1.0, 2.0))
    graph.add_prior(40, planar_step(3, -1, 2), information=np.diag([5.0, 1.0, 2.0]))
    return graph


def _noise(rng: np.random.Generator) -> np.ndarray:
    return se3.exp([0, 0, 0.05 * rng.normal(), *(0.1 * rng.normal(size=2)), 0])


def test_the_error_is_gtsams_at_any_poses(rng):
    data = drifting_graph(rng)._data
    builder, edges = Builder(data), planar_edges(data)
    for spread in (0.0, 1e-6, 5.0):
        poses = data.initial_values + spread * rng.normal(size=(len(data), 3))
        with_origin = np.vstack([poses, np.zeros(3)]).T
        assert edges.error(with_origin) == pytest.approx(builder.graph().error(builder.values(poses)), rel=1e-9)


def test_the_jacobians_are_the_derivatives_of_the_residuals(rng):
    edges = planar_edges(drifting_graph(rng)._data)
    poses = rng.normal(size=(3, 81))
    J_i, J_j = edges.jacobians(poses)
    for k in range(3):
        for ends, J in ((edges.i, J_i), (edges.j, J_j)):
            for m in (0, 30, 79, len(ends) - 1):
                moved = np.zeros_like(poses)
                moved[k, ends[m]] = 1e-6
                slope = (edges.residuals(poses + moved) - edges.residuals(poses - moved))[:, m] / 2e-6
                np.testing.assert_allclose(J[:, k, m], slope, atol=1e-7)


def test_the_optimum_is_gtsams(rng):
    graph = drifting_graph(rng)
    assert solves(graph._data)
    solution = graph.optimize(tolerance=1e-12)
    factors, start = graph.to_gtsam()
    values = gtsam.GaussNewtonOptimizer(factors, start).optimize()
    assert solution.error == pytest.approx(factors.error(values), rel=1e-7)
    expected = np.array([solution.pose(k)[:2, 3] for k in range(80)])
    found = np.array([values.atPose2(k).translation() for k in range(80)])
    np.testing.assert_allclose(found, expected, atol=1e-3)


def test_a_long_chain_is_as_precise_as_by_qr(rng):
    graph, step = PoseGraph(2), planar_step(1.0, 0.0, 1e-3)
    graph.add_prior(0, np.eye(4), sigmas=0.01)
    for k in range(4999):
        graph.add_between(k, k + 1, step @ _noise(rng), sigmas=(0.01, 0.1, 0.1))
    graph.initialise("odometry")
    exact = graph._data.initial_values  # a chain fits its odometry exactly
    bend = np.cumsum(1e-5 * rng.normal(size=exact.shape), axis=0)
    solver = PlanarGaussNewton(graph._data, exact + bend)
    for _ in range(3):
        solver.iterate()
    np.testing.assert_allclose(solver.state(), exact, atol=1e-6)


def test_graphs_with_anything_else_are_left_to_gtsam(rng):
    assert not solves(PoseGraph(3)._data)
    robust = drifting_graph(rng)
    robust.add_between(0, 9, np.eye(4), sigmas=1.0, robust="huber")
    assert not solves(robust._data)
    heading = drifting_graph(rng)
    heading.add_heading(4, 0.3, 0.1)
    assert not solves(heading._data)
