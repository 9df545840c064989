"""Graphs are copied, cut, merged and exchanged with GTSAM without a change of what they say."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.errors import DataError, GraphError
from hybridlio.core.trajectory import read_trajectory
from hybridlio.graph import PoseGraph

SIGMAS = np.array([0.02, 0.03, 0.04, 0.1, 0.2, 0.3])


def square(dimension: int = 3) -> PoseGraph:
    """Return a square of four poses with a loop."""
    used = slice(0, 6) if dimension == 3 else slice(2, 5)
    graph, step = PoseGraph(dimension), se3.exp([0, 0, np.pi / 2, np.pi / 2, 0, 0])
    graph.add_prior(0, np.eye(4), sigmas=1e-2)
    for k in range(3):
        graph.add_between(k, k + 1, step @ se3.exp([0, 0, 0.01 * k, 0.1, 0, 0]), sigmas=SIGMAS[used])
    graph.add_between(3, 0, step, sigmas=SIGMAS[used])
    return graph


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_graph_comes_back_from_gtsam_as_it_was(dimension):
    graph = square(dimension)
    graph.start_from(graph.optimize())
    again = PoseGraph.from_gtsam(*graph.to_gtsam())
    assert again.keys == graph.keys
    assert [factor.kind for factor in again.factors.values()].count("between") == 4
    expected, found = graph.optimize(), again.optimize()
    np.testing.assert_allclose(found.poses, expected.poses, atol=1e-9)
    np.testing.assert_allclose(found.covariance(2), expected.covariance(2), rtol=1e-6)


def test_gtsam_solves_what_to_gtsam_gives():
    graph = square()
    solution = graph.optimize()
    graph.start_from(solution)
    factors, values = graph.to_gtsam()
    assert factors.error(values) == pytest.approx(solution.error, rel=1e-6)
    found = gtsam.LevenbergMarquardtOptimizer(factors, values).optimize()
    np.testing.assert_allclose(found.atPose3(2).matrix(), solution.pose(2), atol=1e-5)


def test_robust_factors_of_gtsams_stay_gtsams():
    graph = square()
    graph.add_between(0, 2, graph.optimize().pose(2), sigmas=SIGMAS, robust="tukey")
    graph.start_from(graph.optimize())
    again = PoseGraph.from_gtsam(*graph.to_gtsam())
    assert [f.kind for f in again.factors.values()].count("gtsam") == 1
    np.testing.assert_allclose(again.optimize().poses, graph.optimize().poses, atol=1e-9)


def test_a_copy_is_independent_and_a_subgraph_holds_what_concerns_its_poses_alone():
    graph = square()
    copy, part = graph.copy(), graph.subgraph([2, 1, 0])
    graph.remove(0)
    assert len(copy.factors) == 5
    assert part.keys == [0, 1, 2]
    assert [f.keys for f in part.factors.values()] == [(0,), (0, 1), (1, 2)]
    np.testing.assert_allclose(part.optimize().pose(1), copy.subgraph([0, 1]).optimize().pose(1), atol=1e-6)


def test_a_removed_pose_takes_its_factors_along():
    graph = square()
    graph.remove_pose(3)
    assert graph.keys == [0, 1, 2]
    assert len(graph.factors) == 3
    graph.add_between(2, 3, np.eye(4), sigmas=SIGMAS)
    assert graph.optimize().keys == [0, 1, 2, 3]


def test_other_noise_changes_the_covariance_alone():
    graph = square().subgraph([0, 1])
    before = graph.optimize()
    graph.set_noise(1, sigmas=2 * SIGMAS)
    after = graph.optimize()
    np.testing.assert_allclose(after.pose(1), before.pose(1), atol=1e-9)
    assert after.relative_covariance(0, 1)[5, 5] == pytest.approx(4 * before.relative_covariance(0, 1)[5, 5], rel=1e-6)


@pytest.mark.parametrize("known", [True, False])
def test_merged_graphs_are_one_map(known):
    ours, theirs, T = square(), square(), se3.exp([0, 0, 0.3, 5, 1, 0])
    alone = theirs.optimize()
    ids = ours.merge(theirs, {k: (1, k) for k in theirs.keys}, T if known else None)
    assert len(ids) == (5 if known else 4)
    if not known:
        ours.add_between(0, (1, 0), T, sigmas=1e-3)
    solution = ours.optimize()
    np.testing.assert_allclose(se3.between(T, solution.pose((1, 2))), alone.pose(2), atol=1e-2)
    with pytest.raises(GraphError, match="keys in use"):
        ours.merge(square())


def test_poses_and_keys_are_taken_in_gtsams_forms():
    graph, T = PoseGraph(), se3.exp([0.1, 0.2, 0.3, 1, 2, 3])
    graph.add_prior(gtsam.symbol("a", 3), gtsam.Pose3(T), sigmas=1e-3)
    graph.add_prior(5, np.r_[1, 2, 3, gtsam.Rot3(T[:3, :3]).toQuaternion().coeffs()], sigmas=1e-3)
    assert graph.keys == [(0, 3), 5]
    np.testing.assert_allclose(graph.initial((0, 3)), T, atol=1e-12)
    planar = PoseGraph(2)
    planar.add_prior(0, [1, 2, 0.5], sigmas=1e-3)
    np.testing.assert_allclose(planar.initial(0)[:2, 3], [1, 2])
    with pytest.raises(DataError, match="quaternion that is not zero"):
        graph.add_prior(6, np.zeros(7), sigmas=1)


def test_a_solution_gives_freedom_trajectory_graphs_and_pictures(tmp_path):
    graph = square()
    wrong = graph.add_between(0, 2, se3.exp([0, 0, 0, 9, 9, 9]), sigmas=SIGMAS * 0.1)
    solution = graph.optimize("gnc")
    assert solution.rejected == {wrong}
    assert solution.degrees_of_freedom == 6 * 5 - 6 * 4
    solution.to_tum(tmp_path / "poses.txt")
    np.testing.assert_allclose(read_trajectory(tmp_path / "poses.txt", None).poses, solution.poses, atol=1e-8)
    np.testing.assert_allclose(solution.trajectory(covariances=True).covariances[2], solution.covariance(2))
    network = solution.to_networkx()
    assert network.number_of_edges() == 5
    assert network.edges[0, 2, wrong]["rejected"]
    assert solution.to_dot().count("--") == 5
    figure = solution.plot()
    figure.savefig(tmp_path / "graph.png")
    assert (tmp_path / "graph.png").stat().st_size > 1000


@pytest.mark.parametrize("dimension", [2, 3])
def test_landmarks_go_to_gtsam_and_come_back(dimension):
    graph, bearing = PoseGraph(dimension), 0.4 if dimension == 2 else [1.0, 0.3, 0.2]
    graph.add_prior(0, np.eye(4), sigmas=1e-3)
    graph.add_between(0, 1, se3.exp([0, 0, 0.1, 1, 0, 0]), sigmas=0.01)
    graph.set_initial(1, se3.exp([0, 0, 0.1, 1, 0, 0]))
    graph.add_bearing_range(0, (11, 5), bearing, 3.0, sigmas=(0.02, 0.1))
    graph.add_point_observation(1, (11, 5), np.r_[2.0, 0.5, 0.3][:dimension], sigmas=0.1)
    factors, values = graph.to_gtsam()
    again = PoseGraph.from_gtsam(factors, values)
    assert len(again.landmarks) == 1
    expected, found = graph.optimize(tolerance=1e-12), again.optimize(tolerance=1e-12)
    np.testing.assert_allclose(found.points[again.landmarks[0]], expected.point((11, 5)), atol=1e-6)
    np.testing.assert_allclose(found.covariance(1), expected.covariance(1), rtol=1e-6)


def test_what_gtsam_has_and_a_pose_graph_cannot_take_is_named():
    values, factors = gtsam.Values(), gtsam.NonlinearFactorGraph()
    values.insert(0, gtsam.Pose3())
    values.insert(gtsam.symbol("l", 1), np.array([1.0, 2.0, 3.0]))
    model = gtsam.noiseModel.Isotropic.Sigma(1, 0.1)
    factors.add(gtsam.RangeFactorWithTransform3D(0, gtsam.symbol("l", 1), 2.0, model, gtsam.Pose3()))
    with pytest.raises(DataError, match="factor 0, a RangeFactorWithTransform3D, cannot be taken"):
        PoseGraph.from_gtsam(factors, values)
    values.insert(gtsam.symbol("b", 0), gtsam.imuBias.ConstantBias())
    with pytest.raises(DataError, match="the value of b0 is neither a pose nor a landmark"):
        PoseGraph.from_gtsam(gtsam.NonlinearFactorGraph(), values)
