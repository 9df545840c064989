"""Weighted loops are solved alike by GTSAM and in arrays; a group costs less to reject than its loops one by one."""

from __future__ import annotations

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.graph import PoseGraph
from hybridlio.graph.model.edge_arrays import edges_of
from hybridlio.graph.outliers.descents import GtsamDescent, PlanarDescent, descent
from hybridlio.graph.outliers.loop_support import LoopSupport
from hybridlio.graph.outliers.weighted_solver import _FURTHER_LOOP, WeightedSolver
from hybridlio.graph.solve.settings import silent

LAP, COUNT = 30, 150


def laps(rng: np.random.Generator) -> PoseGraph:
    """Return planar laps of a circle with a prior and a loop to the lap before at every other pose."""
    graph, step = PoseGraph(2), se3.exp([0, 0, 2 * np.pi / LAP, 1, 0, 0])
    graph.add_prior(0, np.eye(4), sigmas=1e-3)
    for k in range(COUNT - 1):
        graph.add_between(k, k + 1, step @ se3.exp([0, 0, *(0.02 * rng.normal(size=3)), 0]), sigmas=0.02)
    for k in range(LAP, COUNT, 2):
        graph.add_between(k, k - LAP, se3.exp([0, 0, *(0.05 * rng.normal(size=3)), 0]), sigmas=0.05)
    graph.initialise("odometry")
    return graph


def test_arrays_and_gtsam_descend_to_the_same_poses(rng):
    data = laps(rng)._data
    edges = edges_of(data)
    loops, trusted = edges.where(~edges.consecutive), data.copy(without=edges.ids[~edges.consecutive].tolist())
    weights = rng.uniform(0, 1, len(loops.i))
    weights[::5] = 0.0
    ends = []
    for make in (GtsamDescent, PlanarDescent):
        way = make(trusted, loops)
        end = way.solve(way.state(data.initial_values), weights, 50)
        ends.append((way.coordinates(end), way.trusted_chi2(end)))
        assert way.trusted_chi2(way.state(data.initial_values)) == pytest.approx(0, abs=1e-9)
    (by_gtsam, chi2), (in_arrays, same_chi2) = ends
    np.testing.assert_allclose(in_arrays[:, :2], by_gtsam[:, :2], atol=1e-4)
    assert same_chi2 == pytest.approx(chi2, rel=1e-4)
    assert chi2 > 1


def test_the_system_follows_the_loops_that_have_a_weight(rng):
    data = laps(rng)._data
    edges = edges_of(data)
    loops, trusted = edges.where(~edges.consecutive), data.copy(without=edges.ids[~edges.consecutive].tolist())
    way, weights = PlanarDescent(trusted, loops), np.ones(len(loops.i))
    state = way.solve(way.state(data.initial_values), weights, 30)
    without = way.solve(state, np.zeros(len(weights)), 30)
    assert way.trusted_chi2(without) == pytest.approx(0, abs=1e-6)
    again = way.solve(without, weights, 30)
    np.testing.assert_allclose(way.coordinates(again), way.coordinates(state), atol=1e-4)


def test_a_cluster_costs_less_to_reject_than_as_many_single_loops(rng):
    data = laps(rng)._data
    edges = edges_of(data)
    loops, odometry = edges.where(~edges.consecutive), edges.where(edges.consecutive)
    trusted = data.copy(without=loops.ids.tolist())
    count, bound = len(loops.i), 20.0
    cluster = np.arange(count)
    cluster[:10] = 0
    far = data.initial_values
    far[:, 2] += np.arange(COUNT)  # contradicts every loop
    plain = WeightedSolver(descent(trusted, loops), odometry, bound, silent)
    clustered = WeightedSolver(
        descent(trusted, loops), odometry, bound, silent, LoopSupport(0.25, cluster > 0, cluster)
    )
    state = plain.values(far)
    assert (plain.chi2(state) > bound).all()
    rejections = plain.cost(state) - plain.cost_with(state, np.zeros(count, dtype=bool))
    assert rejections == pytest.approx(bound * count)
    rejections = clustered.cost(state) - clustered.cost_with(state, np.zeros(count, dtype=bool))
    assert rejections == pytest.approx(0.25 * bound * (count - 10 + 1 + 9 * _FURTHER_LOOP))  # at the loops' own noise
    assert 0 < _FURTHER_LOOP < 1
