"""Landmarks as variables: batch and online solvers agree with each other, and covariances with the truth."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.errors import DataError, GraphError
from hybridlio.graph import PoseGraph

POSES, LANDMARKS, STEP_SIGMAS = 30, 8, {2: (0.01, 0.03, 0.03), 3: (0.01,) * 3 + (0.03,) * 3}


def truth(dimension: int) -> tuple[np.ndarray, np.ndarray]:
    """Return poses on a circle, and points around it."""
    rng = np.random.default_rng(7)
    poses = [np.eye(4)]
    for _ in range(POSES - 1):
        poses.append(poses[-1] @ se3.exp([0, 0, 2 * np.pi / POSES, 0.8, 0, 0]))
    points = rng.uniform(-6, 10, size=(LANDMARKS, 3))
    points[:, 2] *= dimension == 3
    return np.array(poses), points[:, :dimension]


def measured_graph(dimension: int, seed: int, kind: str = "point", initial: bool = False) -> PoseGraph:
    """Return noisy steps and observations of every landmark from every third pose; landmark k has key (1, k)."""
    rng = np.random.default_rng(seed)
    poses, points = truth(dimension)
    used = slice(0, 6) if dimension == 3 else slice(2, 5)
    sigmas, graph = np.array(STEP_SIGMAS[dimension]), PoseGraph(dimension)
    graph.add_prior(0, np.eye(4), sigmas=1e-4)
    for k in range(POSES):
        if k:
            noise = np.zeros(6)
            noise[used] = sigmas * rng.normal(size=len(sigmas))
            graph.add_between(k - 1, k, se3.between(poses[k - 1], poses[k]) @ se3.exp(noise), sigmas=sigmas)
        for m, point in enumerate(points if k % 3 == 0 else ()):
            local = poses[k, :dimension, :dimension].T @ (point - poses[k, :dimension, 3])
            observe(graph, k, (1, m), local, rng, kind)
    return graph


def observe(graph: PoseGraph, pose: int, key: tuple[int, int], local: np.ndarray, rng, kind: str) -> int:
    if kind == "point":
        return graph.add_point_observation(pose, key, local + 0.05 * rng.normal(size=len(local)), sigmas=0.05)
    distance = np.linalg.norm(local) + 0.05 * rng.normal()
    if len(local) == 2:
        bearing = np.arctan2(local[1], local[0]) + 0.02 * rng.normal()
    else:
        bearing = gtsam.Unit3(local).retract(0.02 * rng.normal(size=2)).point3()
    return graph.add_bearing_range(pose, key, bearing, distance, sigmas=(0.02, 0.05))


@pytest.mark.parametrize("kind", ["point", "bearing-range"])
@pytest.mark.parametrize("dimension", [2, 3])
def test_landmarks_and_poses_are_found_within_their_covariances(dimension, kind):
    poses, points = truth(dimension)
    nees = []
    for seed in range(50):
        solution = measured_graph(dimension, seed, kind).optimize()
        assert solution.converged
        for m in range(LANDMARKS):
            off = solution.point((1, m)) - points[m]
            nees.append(off @ np.linalg.solve(solution.covariance((1, m)), off))
        assert solution.landmarks == [(1, m) for m in range(LANDMARKS)]
        assert solution.covariance((1, 0)).shape == (dimension, dimension)
        np.testing.assert_allclose(solution.pose(POSES - 1), poses[-1], atol=0.3)
    assert 0.8 < np.mean(nees) / dimension < 1.25


@pytest.mark.parametrize("backend", ["incremental", "fixed-lag"])
@pytest.mark.parametrize("dimension", [2, 3])
def test_online_backends_agree_with_batch(dimension, backend):
    graph = measured_graph(dimension, 3)
    batch, online = graph.optimize(tolerance=1e-9), graph.optimize(backend, lag=POSES)
    for key in graph.landmarks:
        np.testing.assert_allclose(online.point(key), batch.point(key), atol=3e-3)
        np.testing.assert_allclose(online.covariance(key), batch.covariance(key), rtol=0.05, atol=1e-6)
    assert online.error == pytest.approx(batch.error, rel=1e-3)


@pytest.mark.parametrize("backend", ["incremental", "fixed-lag"])
@pytest.mark.parametrize("dimension", [2, 3])
def test_a_growing_graph_is_followed(dimension, backend):
    whole = measured_graph(dimension, 5)
    growing = PoseGraph(dimension)
    solver = growing.online(backend, lag=10)
    growing.add_prior(0, np.eye(4), sigmas=1e-4)
    local = truth(dimension)[1]
    rng = np.random.default_rng(5)
    for m, point in enumerate(local):
        observe(growing, 0, (1, m), point, rng, "point")
    solver.update()
    for factor in whole.factors.values():
        if factor.kind == "between":
            T = np.eye(4)
            T[:] = truth(dimension)[0][0]
            i, j = factor.keys
            T = se3.between(truth(dimension)[0][i], truth(dimension)[0][j])
            growing.add_between(i, j, T, sigmas=STEP_SIGMAS[dimension])
            solver.update()
    batch = growing.optimize()
    for m in range(LANDMARKS):
        np.testing.assert_allclose(solver.point((1, m)), batch.point((1, m)), atol=1e-3)
    if backend == "incremental":
        np.testing.assert_allclose(solver.covariance((1, 0)), batch.covariance((1, 0)), rtol=0.05, atol=1e-6)
        return
    with pytest.raises(GraphError, match="has left the lag"):
        solver.covariance((1, 0))
    growing.add_point_observation(POSES - 1, (1, 0), np.ones(dimension), sigmas=1)
    with pytest.raises(GraphError, match=r"landmark \(1, 0\) has left the lag"):
        solver.update()


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_landmark_stays_in_the_lag_while_it_is_observed(dimension):
    poses, points = truth(dimension)
    graph = PoseGraph(dimension)
    graph.add_prior(0, np.eye(4), sigmas=1e-4)
    solver = graph.online("fixed-lag", lag=5)
    for k in range(POSES):
        if k:
            graph.add_between(k - 1, k, se3.between(poses[k - 1], poses[k]), sigmas=STEP_SIGMAS[dimension])
        graph.add_point_observation(
            k, (1, 0), poses[k, :dimension, :dimension].T @ (points[0] - poses[k, :dimension, 3]), sigmas=0.05
        )
        solver.update()
    np.testing.assert_allclose(solver.point((1, 0)), points[0], atol=1e-6)
    assert solver.covariance((1, 0)).shape == (dimension, dimension)


def test_parts_that_share_enough_landmarks_are_one():
    graph = PoseGraph(2)
    graph.add_pose(0, np.eye(4))
    graph.add_pose(1, np.eye(4))
    graph.fix(0)
    for pose in (0, 1):
        graph.add_point_observation(pose, 10, [3.0, 0.0], sigmas=0.1)
    with pytest.raises(GraphError, match="poses 1 are free"):
        graph.optimize()
    for pose in (0, 1):
        graph.add_point_observation(pose, 11, [0.0, 2.0], sigmas=0.1)
    assert graph.components() == [[0, 1]]
    np.testing.assert_allclose(graph.optimize().pose(1), np.eye(4), atol=1e-9)


def test_what_is_wrong_with_landmarks_is_refused_and_leaves_the_graph_as_it_was():
    graph = PoseGraph()
    graph.add_prior(0, np.eye(4), sigmas=1)
    graph.add_landmark(5, [1, 2, 3])
    before = repr(graph)
    for call, error, message in [
        (lambda: graph.add_landmark(0), GraphError, "pose 0 exists already"),
        (lambda: graph.add_landmark(5), GraphError, "landmark 5 exists already"),
        (lambda: graph.add_pose(5), GraphError, "landmark 5 exists already"),
        (lambda: graph.add_prior(5, np.eye(4), sigmas=1), GraphError, "landmark 5 exists already"),
        (lambda: graph.add_between(0, 5, np.eye(4), sigmas=1), GraphError, "landmark 5 exists already"),
        (lambda: graph.add_landmark(6, [1, 2]), DataError, "expected 3 finite numbers"),
        (lambda: graph.add_point_observation(0, 0, [1, 2, 3], sigmas=1), GraphError, "is a pose, not a landmark"),
        (lambda: graph.add_point_observation(5, 6, [1, 2, 3], sigmas=1), GraphError, "it is a landmark"),
        (lambda: graph.add_point_observation(0, 6, [0, 0, 0], sigmas=1), DataError, "no bearing"),
        (lambda: graph.add_point_observation(0, 6, [1, 2, 3]), GraphError, "exactly one of covariance"),
        (lambda: graph.add_bearing_range(0, 6, [1, 0, 0], -1, [1, 1]), DataError, "range must be positive"),
        (lambda: graph.add_bearing_range(0, 6, [0, 0, 0], 1, [1, 1]), DataError, "must not be zero"),
        (lambda: graph.add_bearing_range(0, 6, 0.5, 1, [1, 1]), DataError, "expected 3 finite numbers"),
        (lambda: graph.fix(5), GraphError, "it is a landmark"),
        (graph.optimize, GraphError, "no factor observes landmark 5"),
    ]:
        with pytest.raises(error, match=message):
            call()
        assert repr(graph) == before
    assert repr(graph) == "<PoseGraph 3D: 1 poses, 1 landmarks, 0 fixed, 0 between-factors, 1 other factors>"


def test_a_solution_gives_landmarks_as_initial_values():
    graph = measured_graph(3, 1)
    solution = graph.optimize()
    assert repr(solution).startswith("<Solution: 30 poses, 8 landmarks, error")
    graph.start_from(solution)
    np.testing.assert_array_equal(graph.initial((1, 2)), solution.point((1, 2)))
    assert graph.optimize(initial="given").error_before == pytest.approx(solution.error)
    with pytest.raises(GraphError, match="no landmark has key 99"):
        solution.point(99)


def test_robust_kernels_and_gnc_take_landmarks():
    graph = measured_graph(2, 1)
    right = graph.optimize().point((1, 0))
    wrong = graph.add_point_observation(4, (1, 0), [40.0, 9.0], sigmas=0.05, robust="geman-mcclure")
    solution = graph.optimize()
    np.testing.assert_allclose(solution.point((1, 0)), right, atol=1e-3)
    assert solution.weight(wrong) < 1e-3
    assert solution.residual(wrong).shape == (2,)
    graph.remove(wrong)
    loop = graph.add_between(0, 12, se3.exp([0, 0, 1, 9, 9, 0]), sigmas=STEP_SIGMAS[2])
    assert graph.optimize("gnc").rejected == {loop}
