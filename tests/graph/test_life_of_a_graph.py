"""Graphs that live on: poses are marginalised, and measurements are replaced."""

from __future__ import annotations

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.errors import DataError, GraphError
from hybridlio.graph import PoseGraph

STEP = se3.exp([0, 0, 0.3, 1, 0, 0])


def circle(dimension: int, rng: np.random.Generator, count: int = 24) -> PoseGraph:
    graph, used = PoseGraph(dimension), slice(0, 6) if dimension == 3 else slice(2, 5)
    sigmas = np.array([0.01, 0.01, 0.02, 0.05, 0.05, 0.05])

    def noisy(T):
        xi = np.zeros(6)
        xi[used] = (sigmas * rng.standard_normal(6))[used]
        return T @ se3.exp(xi)

    graph.add_prior(0, np.eye(4), sigmas=1e-2)
    for k in range(count - 1):
        graph.add_between(k, k + 1, noisy(STEP), sigmas=sigmas[used])
    around = se3.exp(21 * np.array([0, 0, 0.3, 1, 0, 0]))
    graph.add_between(0, 21, noisy(around), sigmas=sigmas[used])
    graph.add_between(2, 23, noisy(around), sigmas=sigmas[used])
    graph.add_gps(10, np.zeros(dimension), 5.0)
    return graph


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("gone", [[0], [1, 2, 3, 4], [23], [0, 5, 10, 21], list(range(20))])
def test_marginalised_poses_leave_the_others_and_their_covariances_as_they_were(dimension, gone):
    graph = circle(dimension, np.random.default_rng(1))
    before = graph.optimize(tolerance=1e-12)
    number = graph.marginalise(gone, before)
    assert number in graph.factors
    assert not set(gone) & set(graph.keys)
    after = graph.optimize()
    for key in graph.keys:
        np.testing.assert_allclose(after.pose(key), before.pose(key), atol=1e-4)  # σ is 0.02
        np.testing.assert_allclose(after.covariance(key), before.covariance(key), rtol=1e-3, atol=1e-7)


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_marginal_is_saved_and_merged(dimension, tmp_path):
    graph = circle(dimension, np.random.default_rng(3))
    graph.marginalise([1, 2, 3], graph.optimize())
    graph.marginalise([20, 21], graph.optimize())
    graph.save(tmp_path / "small.npz")
    loaded, expected = PoseGraph.load(tmp_path / "small.npz"), graph.optimize()
    assert dict.fromkeys(loaded.factors) == dict.fromkeys(graph.factors)
    np.testing.assert_allclose(loaded.optimize().poses, expected.poses, atol=1e-9)
    moved, T = PoseGraph(dimension), se3.exp([0, 0, 1.0, 5, 3, 0])
    moved.merge(graph, T_world_other=T)
    fixes = [n for n, factor in graph.factors.items() if factor.kind == "gps"]
    for number in fixes:
        graph.remove(number)
    np.testing.assert_allclose(moved.optimize().poses, T @ graph.optimize().poses, atol=1e-5)
    with pytest.raises(GraphError, match="cannot hold 2 × marginal"):
        graph.save(tmp_path / "small.g2o")
    number = next(n for n, factor in graph.factors.items() if factor.kind == "marginal")
    with pytest.raises(GraphError, match="marginals and code are no measurement"):
        graph.set_measurement(number, np.eye(4))


def test_a_marginal_acts_on_what_comes_later():
    whole = circle(3, np.random.default_rng(2))
    small = whole.copy()
    small.marginalise(range(1, 20), small.optimize())
    there = whole.optimize().pose(23) @ STEP @ se3.exp([0, 0, 0.01, 0.02, 0, 0])
    for graph in (whole, small):
        graph.add_between(23, 24, STEP, sigmas=0.05)
        graph.add_prior(24, there, sigmas=0.05)
    expected, found = whole.optimize(), small.optimize()
    for key in small.keys:
        np.testing.assert_allclose(found.pose(key), expected.pose(key), atol=3e-4)  # of 0.02 that poses move
    assert small.copy().optimize().error == pytest.approx(found.error)
    factors, _ = small.to_gtsam()
    assert factors.size() == len(small.factors)


def test_what_cannot_be_marginalised_is_named():
    graph = circle(3, np.random.default_rng(3))
    solution = graph.optimize()
    with pytest.raises(GraphError, match="no pose has key 99"):
        graph.marginalise([99], solution)
    with pytest.raises(GraphError, match="marginalise: no pose would stay"):
        graph.marginalise(graph.keys, solution)
    with pytest.raises(DataError, match="expected a solution, got int"):
        graph.marginalise([1], 3)
    graph.add_bearing_range(5, 100, [1, 0, 0], 3.0, (0.1, 0.1))
    with pytest.raises(GraphError, match="marginalise: bearing-range 5-100 concerns more than poses"):
        graph.marginalise([5], solution)
    graph.marginalise([8], solution)
    graph.add_between(23, 24, STEP, sigmas=0.1)
    with pytest.raises(GraphError, match="marginalise: the solution has no pose 24"):
        graph.marginalise([7], solution)


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_replaced_measurement_acts_as_one_that_was_added_so(dimension):
    rng = np.random.default_rng(4)
    graph = circle(dimension, rng)
    loop = next(n for n, f in graph.factors.items() if f.keys == (0, 21))
    gps = next(n for n, f in graph.factors.items() if f.kind == "gps")
    other = se3.exp(21 * np.array([0, 0, 0.3, 1, 0, 0])) @ se3.exp([0, 0, 0.1, 0.2, 0, 0])
    noise = graph.factors[loop].noise
    new = graph.set_measurement(loop, other)
    moved = graph.set_measurement(gps, np.ones(dimension))
    assert new not in (loop, gps)
    np.testing.assert_array_equal(graph.factors[new].noise.values, noise.values)
    assert graph.factors[moved].measured[:dimension].tolist() == [1.0] * dimension
    expected = graph.copy()
    expected.remove(new)
    expected.add_between(0, 21, other, covariance=noise.covariance)
    np.testing.assert_allclose(graph.optimize().poses, expected.optimize().poses, atol=1e-6)


def test_measurements_of_every_kind_are_replaced():
    graph = PoseGraph()
    graph.add_prior(0, np.eye(4), sigmas=1)
    given = {
        graph.add_attitude(0, [0, 0, 1], [0, 0, 1], 0.1): ([0, 1, 0], [0, 0, 1, 0, 1, 0]),
        graph.add_velocity(0, [1, 2, 3], 1): ([3, 2, 1], [3, 2, 1]),
        graph.add_altitude(0, 3, 1): (4, [4]),
        graph.add_heading(0, 0.3, 1): (0.4, [0.4]),
        graph.add_bias(0, np.zeros(3), np.zeros(3), 1): (np.arange(6), np.arange(6)),
        graph.add_point_observation(0, 9, [1, 2, 3], sigmas=1): ([3, 2, 1], [3, 2, 1]),
        graph.add_bearing_range(0, 9, [1, 0, 0], 2, (1, 1)): (([0, 2, 0], 3), [0, 1, 0, 3]),
    }
    for number, (measured, expected) in given.items():
        np.testing.assert_allclose(graph.factors[graph.set_measurement(number, measured)].measured, expected)
    code = graph.add_factor(0, lambda T: T[0, 3], 1.0)
    for number, value, message in (
        (code, 1, "samples, marginals and code are no measurement to replace"),
        (99, 1, "no factor has id 99"),
        (next(iter(graph.factors)), np.zeros((4, 4)), "prior 0"),
    ):
        with pytest.raises((GraphError, DataError), match=message):
            graph.set_measurement(number, value)
