"""Factors that users write, and those of GTSAM's, act as the built-in ones of the same measurement."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.errors import DataError, GraphError
from hybridlio.graph import KERNELS, PoseGraph
from hybridlio.graph.model.user_residual import altitude, heading

SIGMAS = np.array([0.02, 0.03, 0.04, 0.1, 0.2, 0.3])
STEP = se3.exp([0.1, -0.2, 0.3, 1, 2, 3])


def chain(dimension: int, count: int = 4) -> PoseGraph:
    size = slice(0, 6) if dimension == 3 else slice(2, 5)
    graph, xi = PoseGraph(dimension), np.zeros(6)
    xi[size] = np.array([0.1, -0.2, 0.3, 1.0, 0.5, 0.2])[size]
    graph.add_prior(0, np.eye(4), sigmas=1e-3)
    for k in range(count - 1):
        graph.add_between(k, k + 1, se3.exp(xi), sigmas=SIGMAS[size])
    return graph


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("backend", ["batch", "incremental"])
def test_a_residual_in_python_acts_as_the_built_in_factor(dimension, backend):
    used = slice(0, 6) if dimension == 3 else slice(2, 5)
    built_in, own = chain(dimension), chain(dimension)
    # near the chain's own, because GTSAM's derivative of a large residual is approximate
    T_0_3 = built_in.optimize().pose(3) @ se3.exp([0, 0, 0.01, 0.05, -0.05, 0])
    number = built_in.add_between(0, 3, T_0_3, sigmas=SIGMAS[used])

    def residual(T_0, T_3):
        return se3.log(se3.between(T_0_3, se3.between(T_0, T_3)))[used]

    own_number = own.add_factor([0, 3], residual, SIGMAS[used])
    expected, found = built_in.optimize(backend), own.optimize(backend)
    np.testing.assert_allclose(found.poses, expected.poses, atol=1e-3)
    np.testing.assert_allclose(found.residual(own_number), expected.residual(number), atol=1e-3)
    assert found.chi2(own_number) == pytest.approx(expected.chi2(number), rel=0.02)


def test_a_factor_of_gtsams_acts_as_the_built_in_one():
    built_in, own = chain(3), chain(3)
    built_in.add_between(0, 3, STEP, sigmas=SIGMAS, robust="cauchy")
    model = gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Cauchy(np.sqrt(12.591587)), gtsam.noiseModel.Diagonal.Sigmas(SIGMAS)
    )
    own.add_gtsam_factor([0, 3], gtsam.BetweenFactorPose3(5, 7, gtsam.Pose3(STEP), model))
    np.testing.assert_allclose(own.optimize().poses, built_in.optimize().poses, atol=1e-6)


def test_a_wrong_jacobian_or_size_is_refused_when_the_factor_is_added():
    graph = chain(3)
    with pytest.raises(DataError, match=r"custom 1: the Jacobian by pose 0 differs.*rotation first"):
        graph.add_factor(1, lambda T: T[:3, 3], (1, 1, 1), lambda T: [np.hstack([T[:3, :3], np.zeros((3, 3))])])
    with pytest.raises(DataError, match="must be 2 finite numbers"):
        graph.add_factor(1, lambda T: T[:3, 3], (1, 1))
    with pytest.raises(GraphError, match="no pose has key 9"):
        graph.add_factor([1, 9], lambda a, b: a[0, 3] - b[0, 3], 1.0)
    assert len(graph.factors) == 4
    graph.add_factor(1, lambda T: T[:3, 3], (1, 1, 1), lambda T: [np.hstack([np.zeros((3, 3)), T[:3, :3]])])


@pytest.mark.parametrize("residual", [altitude(2.0, "a"), heading(0.3, "h", 3), heading(0.3, "h", 2)])
def test_derivatives_of_altitude_and_heading_are_right(residual):
    residual.check([se3.exp([0.3, -0.4, 0.8, 1, 2, 3] if residual.dimension == 3 else [0, 0, 0.8, 1, 2, 0])])


def test_altitude_and_heading_move_a_free_chain():
    graph = chain(3)
    graph.add_altitude(3, 1.5, 1e-4)
    graph.add_heading(3, 0.5, 1e-4)
    T = graph.optimize().pose(3)
    assert T[2, 3] == pytest.approx(1.5, abs=1e-3)
    assert np.arctan2(T[1, 0], T[0, 0]) == pytest.approx(0.5, abs=1e-3)


@pytest.mark.parametrize("backend", ["batch", "incremental"])
def test_a_wheel_speed_is_a_velocity_in_the_frame_of_the_body(backend):
    graph = chain(3)
    graph.add_wheel_speed(2, 3.0, 0.1, 0.01)
    solution = graph.optimize(backend)
    np.testing.assert_allclose(solution.pose(2)[:3, :3].T @ solution.velocity(2), [3, 0, 0], atol=1e-6)


def test_user_code_is_not_saved(tmp_path):
    graph = chain(3)
    graph.add_factor(1, lambda T: T[0, 3], 1.0)
    with pytest.raises(GraphError, match="code"):
        graph.save(tmp_path / "graph.npz")


@pytest.mark.parametrize("kernel", KERNELS)
def test_every_kernel_keeps_a_right_loop(kernel):
    graph = chain(3)
    graph.add_between(0, 3, graph.optimize().pose(3), sigmas=SIGMAS, robust=kernel)
    assert graph.optimize().error < 1e-6
