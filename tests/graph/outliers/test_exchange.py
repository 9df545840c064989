"""What loops would change where they are left out or taken in, to first order, and what rejection makes of it."""

from __future__ import annotations

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.graph import PoseGraph
from hybridlio.graph.model.edge_arrays import edges_of
from hybridlio.graph.outliers.descents import GtsamDescent, PlanarDescent, descent
from hybridlio.graph.outliers.exchange import contradicted, exchanged, is_sure
from hybridlio.graph.outliers.linear_changes import LinearChanges
from hybridlio.graph.outliers.weighted_solver import LARGEST_GROUP, Found, WeightedSolver, least
from hybridlio.graph.solve.settings import silent

SIGMA, COUNT = 0.05, 72


def corridor(rng: np.random.Generator, dimension: int) -> PoseGraph:
    """Return a straight path whose first three quarters have a loop from every other pose to the sixth before it."""
    used = slice(0, 6) if dimension == 3 else slice(2, 5)

    def noisy(x_m: float) -> np.ndarray:
        xi = np.zeros(6)
        xi[used] = SIGMA * rng.standard_normal(6)[used]
        return se3.exp([0, 0, 0, x_m, 0, 0]) @ se3.exp(xi)

    graph = PoseGraph(dimension)
    graph.fix(graph.add_pose(0, np.eye(4)) or 0)
    for k in range(COUNT - 1):
        graph.add_between(k, k + 1, noisy(1), sigmas=SIGMA)
    for k in range(6, 3 * COUNT // 4, 2):
        graph.add_between(k - 6, k, noisy(6), sigmas=SIGMA)
    graph.initialise("odometry")
    return graph


def solver_of(graph: PoseGraph, bound: float) -> WeightedSolver:
    data = graph._data
    edges = edges_of(data)
    loops, odometry = edges.where(~edges.consecutive), edges.where(edges.consecutive)
    return WeightedSolver(descent(data.copy(without=loops.ids.tolist()), loops), odometry, bound, silent)


def chi2_of(solver: WeightedSolver, values, correct) -> float:
    end = solver.solve(values, correct.astype(float), 50)
    return solver._descent.trusted_chi2(end) + solver.chi2(end)[correct].sum()


@pytest.mark.parametrize("dimension", [2, 3])
def test_changes_to_first_order_are_those_of_solving_again(rng, dimension):
    graph = corridor(rng, dimension)
    solver = solver_of(graph, 20.0)
    correct = np.arange(len(solver.loops.i)) % 4 != 0
    values = solver.solve(solver.values(graph._data.initial_values), correct.astype(float), 50)
    before, changes = chi2_of(solver, values, correct), LinearChanges(solver.linear(values), correct, 1e9)
    for k in (0, 4, 1, 6):
        other = correct ^ (np.arange(len(correct)) == k)
        change = chi2_of(solver, values, other) - before
        assert changes.single[k] == pytest.approx(change if other[k] else -change, rel=0.1, abs=0.05)


@pytest.mark.parametrize("dimension", [2, 3])
def test_loops_that_are_left_out_together_change_the_error_as_solving_again_does(rng, dimension):
    graph = corridor(rng, dimension)
    solver = solver_of(graph, 20.0)
    everything = np.ones(len(solver.loops.i), dtype=bool)
    values = solver.solve(solver.values(graph._data.initial_values), everything.astype(float), 50)
    some = np.isin(np.arange(len(everything)), (0, 1, 2, 5))
    change, single = LinearChanges(solver.linear(values), everything, 1e9).exchange(some)
    without = chi2_of(solver, values, ~some)
    assert change == pytest.approx(without - chi2_of(solver, values, everything), rel=0.1)
    assert np.isnan(single[some]).all()
    for k in (6, 7):  # after the exchange
        saved = without - chi2_of(solver, values, ~some ^ (np.arange(len(some)) == k))
        assert single[k] == pytest.approx(saved, rel=0.1, abs=0.05)


def test_arrays_and_gtsam_have_the_same_whitened_residuals(rng):
    data = corridor(rng, 2)._data
    edges = edges_of(data)
    loops, trusted = edges.where(~edges.consecutive), data.copy(without=edges.ids[~edges.consecutive].tolist())
    both = []
    for way in (GtsamDescent(trusted, loops), PlanarDescent(trusted, loops)):
        linear = way.linear(way.state(data.initial_values))
        both.append(((linear.residual[linear.trusted :].reshape(-1, 3) ** 2).sum(axis=1), linear.jacobian.shape[1]))
    (by_gtsam, _), (in_arrays, columns) = both
    np.testing.assert_allclose(by_gtsam, in_arrays, rtol=1e-6)
    assert columns == 3 * (COUNT - 1)  # the fixed pose is no variable


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_wrong_loop_that_bends_the_map_is_left_out(rng, dimension):
    """Its residual is within the bound, and only what the others say without it tells it from the correct ones."""
    graph = corridor(rng, dimension)
    wrong = graph.add_between(56, 70, se3.exp([0, 0, 0, 15.4, 0, 0]), sigmas=SIGMA)  # 14 m: 7 deviations of the path
    solver = solver_of(graph, 20.0)
    everything = np.ones(len(solver.loops.i), dtype=bool)
    bent = solver.found(solver.values(graph._data.initial_values), everything)
    assert bent.correct.all()
    better = least([bent, *exchanged(solver, np.arange(len(everything)), bent, 1.0)])
    assert solver.loops.ids[~better.correct].tolist() == [wrong]
    assert better.cost < bent.cost
    back = least([better, *exchanged(solver, np.arange(len(everything)), better, 1.0)])
    assert back is better


def test_rejecting_a_large_cluster_is_discounted_for_one_misleading_place_alone(rng):
    solver = solver_of(corridor(rng, 2), 20.0)
    count = len(solver.loops.i)
    assert count > LARGEST_GROUP
    solver._cluster = np.zeros(count, dtype=np.int64)
    everything = np.ones(count, dtype=bool)
    saved = 20.0 * count - solver.cost_of_rejecting(everything)
    assert saved == pytest.approx(20.0 * 0.75 * (LARGEST_GROUP - 1))


def test_a_group_is_contradicted_unless_it_fits_without_one_loop_that_resists_it(rng):
    graph = corridor(rng, 2)
    resisting = graph.add_between(56, 70, se3.exp([0, 0, 0, 14.1, 0, 0]), sigmas=SIGMA / 10)
    for k in range(2):  # fits the path, but for the loop above
        graph.add_between(56 + k, 69 + k, se3.exp([0, 0, 0, 13.6, 0, 0]), sigmas=SIGMA)
    for k in range(2):  # fits nothing
        graph.add_between(4 + k, 20 + k, se3.exp([0, 0, 0, 2, 0, 0]), sigmas=SIGMA)
    solver = solver_of(graph, 10.0)
    cluster = np.arange(len(solver.loops.i))
    fitting, wrong = np.zeros((2, len(cluster)), dtype=bool)
    fitting[-4:-2], wrong[-2:] = True, True
    values = solver.solve(solver.values(graph._data.initial_values), (~fitting & ~wrong).astype(float), 50)
    best = Found(values, ~fitting & ~wrong, 0.0, 0.0)
    assert best.correct[solver.loops.ids == resisting].all()
    assert contradicted(solver, cluster, best, [wrong])
    assert not contradicted(solver, cluster, best, [fitting])
    assert not contradicted(solver, cluster, best, [wrong, fitting])


def test_a_result_is_sure_unless_a_rejected_loop_nearly_pays_for_itself(rng):
    graph = corridor(rng, 2)
    far = graph.add_between(4, 20, se3.exp([0, 0, 0, 2, 0, 0]), sigmas=SIGMA)
    near = graph.add_between(56, 70, se3.exp([0, 0, 0, 14.4, 0, 0]), sigmas=SIGMA)  # odometry drifts by 0.19 m there
    solver = solver_of(graph, 4.0)
    correct = ~np.isin(solver.loops.ids, [far, near])
    values = solver.solve(solver.values(graph._data.initial_values), correct.astype(float), 50)
    cluster = np.arange(len(correct))
    assert not is_sure(solver, cluster, Found(values, correct, 0.0, 0.0))
    solver.price = 0.4  # ten times less noise than is stated
    assert is_sure(solver, cluster, Found(values, correct, 0.0, 0.0))
