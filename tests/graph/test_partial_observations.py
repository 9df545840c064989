"""Landmarks that ranges or bearings alone observe are placed, or the error says what is missing."""

from __future__ import annotations

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.errors import DataError, GraphError
from hybridlio.graph import PoseGraph

POSES, SIGMA = 24, 0.05
BEACONS = {2: np.array([[4.0, 3.0], [-3.0, 8.0]]), 3: np.array([[4.0, 3.0, 2.0], [-3.0, 8.0, -1.0]])}


def path(dimension: int, straight: bool = False) -> np.ndarray:
    """Return poses on a circle, which climbs in space, or on a line."""
    turn = 0 if straight else 2 * np.pi / POSES
    climb = 0 if dimension == 2 or straight else 0.1
    poses = [np.eye(4)]
    for k in range(POSES - 1):
        poses.append(poses[-1] @ se3.exp([0, climb * np.sin(0.7 * k), turn, 1, 0, 0]))
    return np.array(poses)


def observed(rng: np.random.Generator, dimension: int, kinds: tuple[str, ...], straight: bool = False) -> PoseGraph:
    poses, graph = path(dimension, straight), PoseGraph(dimension)
    graph.add_prior(0, poses[0], sigmas=1e-4)
    for k in range(1, POSES):
        graph.add_between(k - 1, k, se3.between(poses[k - 1], poses[k]), sigmas=0.02)
    for k in range(0, POSES, 2):
        for m, beacon in enumerate(BEACONS[dimension]):
            local = poses[k, :dimension, :dimension].T @ (beacon - poses[k, :dimension, 3])
            if "range" in kinds:
                graph.add_range(k, (1, m), float(np.linalg.norm(local)) + SIGMA * rng.normal(), sigma_m=SIGMA)
            if "bearing" in kinds:
                off = local + SIGMA * np.linalg.norm(local) * 0.1 * rng.normal(size=dimension)
                bearing = np.arctan2(off[1], off[0]) if dimension == 2 else off
                graph.add_bearing(k, (1, m), bearing, sigma_rad=0.1 * SIGMA)
    return graph


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("kinds", [("range",), ("bearing",), ("range", "bearing")])
def test_ranges_and_bearings_place_a_landmark_within_its_covariance(rng, dimension, kinds):
    graph = observed(rng, dimension, kinds)
    solution = graph.optimize()
    assert solution.converged
    for m, beacon in enumerate(BEACONS[dimension]):
        error = solution.point((1, m)) - beacon
        covariance = solution.covariance((1, m))
        assert error @ np.linalg.solve(covariance, error) < 20  # beyond 99.9 % of three degrees of freedom
        assert np.sqrt(np.trace(covariance)) < 1


@pytest.mark.parametrize("dimension", [2, 3])
def test_they_are_kept_in_files_and_copies(rng, dimension, tmp_path):
    graph = observed(rng, dimension, ("range", "bearing"))
    graph.initialise("odometry")
    graph.save(tmp_path / "map.npz")
    solution = graph.optimize()
    for other in (PoseGraph.load(tmp_path / "map.npz"), graph.copy(), PoseGraph.from_gtsam(*graph.to_gtsam())):
        assert other.optimize().error == pytest.approx(solution.error, rel=1e-4)
    with pytest.raises(GraphError, match=r"save as \.npz"):
        graph.save(tmp_path / "map.g2o")


def test_ranges_from_a_straight_line_leave_the_side_open(rng):
    graph = observed(rng, 2, ("range",), straight=True)
    with pytest.raises(GraphError, match=r"several places.*add_landmark"):
        graph.optimize()
    given = PoseGraph(2)
    for m, beacon in enumerate(BEACONS[2]):
        given.add_landmark((1, m), beacon + 0.5)
    for key in graph.keys:
        given.add_pose(key)
    for factor in graph.factors.values():
        given._data.add_factor(factor)
    np.testing.assert_allclose(given.optimize().point((1, 0)), BEACONS[2][0], atol=0.5)


def test_too_few_observations_are_named():
    graph = PoseGraph(2)
    graph.add_prior(0, np.eye(4), sigmas=0.01)
    graph.add_range(0, (1, 0), 5.0, sigma_m=0.1)
    with pytest.raises(GraphError, match=r"too few ranges and bearings observe landmark \(1, 0\)"):
        graph.optimize()
    graph.add_bearing(0, (1, 0), 0.5, sigma_rad=0.01)
    np.testing.assert_allclose(graph.optimize().point((1, 0)), 5 * np.array([np.cos(0.5), np.sin(0.5)]), atol=1e-6)


def test_measurements_without_sense_are_refused():
    graph = PoseGraph(3)
    graph.add_pose(0, np.eye(4))
    with pytest.raises(DataError, match="range must be positive"):
        graph.add_range(0, (1, 0), 0.0, sigma_m=0.1)
    with pytest.raises(DataError, match="direction must not be zero"):
        graph.add_bearing(0, (1, 0), [0, 0, 0], sigma_rad=0.1)
    number = graph.add_range(0, (1, 0), 2.0, sigma_m=0.1)
    assert graph.factors[graph.set_measurement(number, 3.0)].measured == [3.0]


def test_an_online_solver_takes_them_of_a_landmark_that_is_placed(rng):
    graph = PoseGraph(2)
    solver = graph.online()
    graph.add_prior(0, np.eye(4), sigmas=0.01)
    graph.add_bearing_range(0, (1, 0), 0.0, 5.0, sigmas=(0.1, 0.5))
    solver.update()
    graph.add_range(0, (1, 0), 5.2, sigma_m=0.01)
    solver.update()
    assert solver.point((1, 0))[0] == pytest.approx(5.2, abs=0.01)
    graph.add_range(0, (1, 1), 5.0, sigma_m=0.1)
    with pytest.raises(GraphError, match="first needs a point"):
        solver.update()
