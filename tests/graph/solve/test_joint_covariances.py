from __future__ import annotations

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.errors import GraphError
from hybridlio.graph import PoseGraph

SIGMAS = (0.01, 0.02, 0.03, 0.1, 0.2, 0.3)


def chain() -> PoseGraph:
    graph = PoseGraph()
    graph.add_prior(0, np.eye(4), sigmas=SIGMAS)
    for k in range(4):
        graph.add_between(k, k + 1, se3.exp([0, 0, 0.3, 1.0, 0, 0]), sigmas=SIGMAS)
    graph.add_velocity(4, [1.0, 0.0, 0.0], [0.1, 0.2, 0.3])
    return graph


def test_the_blocks_of_a_joint_covariance_are_the_marginals_and_give_the_relative_covariance():
    solution = chain().optimize()
    joint = solution.joint_covariance([1, 3])
    np.testing.assert_allclose(joint[:6, :6], solution.covariance(1), rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(joint[6:, 6:], solution.covariance(3), rtol=1e-6, atol=1e-12)
    T_3_1 = se3.between(solution.pose(3), solution.pose(1))
    J = np.hstack([-se3.adjoint(T_3_1), np.eye(6)])
    np.testing.assert_allclose(J @ joint @ J.T, solution.relative_covariance(1, 3), rtol=1e-6, atol=1e-12)


def test_the_order_of_the_keys_is_that_of_the_blocks_in_the_plane_too():
    graph = PoseGraph(dimension=2)
    graph.add_prior(0, np.eye(4), sigmas=(0.01, 0.1, 0.2))
    graph.add_between(0, 1, [1.0, 0.0, 0.5], sigmas=(0.02, 0.3, 0.4))
    solution = graph.optimize()
    joint = solution.joint_covariance([1, 0])
    np.testing.assert_allclose(joint[:3, :3], solution.covariance(1), rtol=1e-6)
    np.testing.assert_allclose(np.sqrt(np.diag(joint[3:, 3:])), (0.01, 0.1, 0.2), rtol=1e-6)


def test_a_velocity_that_is_measured_alone_has_the_covariance_of_its_measurement():
    solution = chain().optimize()
    np.testing.assert_allclose(solution.velocity_covariance(4), np.diag([0.01, 0.04, 0.09]), rtol=1e-6)
    with pytest.raises(GraphError, match="has no biases"):
        solution.bias_covariance(4)
