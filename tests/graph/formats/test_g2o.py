import gtsam
import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.errors import GraphError
from hybridlio.core.estimates import RelativePose
from hybridlio.graph import PoseGraph
from hybridlio.graph.formats.g2o import write_g2o


def chain(rng: np.random.Generator, count: int) -> tuple[np.ndarray, list[tuple[int, int, RelativePose]]]:
    """Return poses kilometres from the origin, and steps between them with full covariances."""
    poses, edges = [se3.exp([0.1, -0.2, 0.3, 1234.56789, -4321.98765, 12.3])], []
    for k in range(count - 1):
        root = rng.normal(size=(6, 6)) * [1e-3, 1e-3, 1e-3, 1e-2, 1e-2, 1e-2]
        step = RelativePose(se3.exp(rng.normal(size=6)), root @ root.T + 1e-8 * np.eye(6), source="test")
        edges.append((k, k + 1, step))
        poses.append(poses[-1] @ step.pose @ se3.exp(rng.normal(size=6) * 1e-3))
    return np.array(poses), edges


def test_gtsam_reads_back_the_same_poses_and_factors(rng, tmp_path):
    poses, edges = chain(rng, 6)
    write_g2o(tmp_path / "graph.g2o", poses, edges)
    graph, values = gtsam.readG2o(str(tmp_path / "graph.g2o"), True)
    for k, pose in enumerate(poses):
        np.testing.assert_allclose(values.atPose3(k).matrix(), pose, atol=1e-9)
    assert graph.size() == len(edges)
    for index, (i, j, step) in enumerate(edges):
        factor = graph.at(index)
        assert list(factor.keys()) == [i, j]
        np.testing.assert_allclose(factor.measured().matrix(), step.pose, atol=1e-12)
        noise = gtsam.noiseModel.Gaussian.Covariance(step.covariance)
        expected = gtsam.BetweenFactorPose3(i, j, gtsam.Pose3(step.pose), noise).error(values)
        np.testing.assert_allclose(factor.error(values), expected, rtol=1e-6)


def test_vertex_numbers_may_start_anywhere(rng, tmp_path):
    poses, edges = chain(rng, 3)
    write_g2o(tmp_path / "graph.g2o", poses, [(i + 7, j + 7, step) for i, j, step in edges], first=7)
    graph, values = gtsam.readG2o(str(tmp_path / "graph.g2o"), True)
    assert sorted(values.keys()) == [7, 8, 9]
    np.testing.assert_allclose(values.atPose3(7).matrix(), poses[0], atol=1e-9)
    assert list(graph.at(0).keys()) == [7, 8]


def test_a_pose_that_no_row_would_name_is_refused(tmp_path):
    graph = PoseGraph()
    graph.add_pose(1)
    graph.add_gps(1, [0, 0, 0], 0.1)
    graph.add_pose(0)
    with pytest.raises(GraphError, match="no initial value to write"):
        graph.save(tmp_path / "graph.g2o")
    graph.add_between(1, 0, np.eye(4), sigmas=0.1)
    graph.save(tmp_path / "graph.g2o")
    assert set(PoseGraph.load(tmp_path / "graph.g2o").keys) == {0, 1}
