"""Online solvers that test outliers leave wrong measurements out while the graph grows, and keep the others."""

from __future__ import annotations

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.errors import ConfigError, GraphError
from hybridlio.graph import OnlineSolver, PoseGraph

LAP = 20
SIGMAS = np.array([0.01, 0.01, 0.01, 0.05, 0.05, 0.05])
STEP = se3.exp([0, 0, 2 * np.pi / LAP, 1, 0, 0])
WRONG = se3.exp([0, 0, 1.0, 4.0, 3.0, 0])


def used(dimension: int) -> slice:
    return slice(0, 6) if dimension == 3 else slice(2, 5)


def noisy(rng: np.random.Generator, T: np.ndarray, dimension: int) -> np.ndarray:
    xi = np.zeros(6)
    xi[used(dimension)] = (SIGMAS * rng.standard_normal(6))[used(dimension)]
    return T @ se3.exp(xi)


class Laps:
    """Laps of a circle that grow with a solver: a loop to the last lap at every other pose, some wrong."""

    def __init__(self, rng: np.random.Generator, dimension: int, backend: str, outliers: str | None, **lag: int):
        self.rng, self.dimension = rng, dimension
        self.graph = PoseGraph(dimension)
        self.graph.add_prior(0, np.eye(4), sigmas=1e-3)
        self.solver: OnlineSolver = self.graph.online(backend, outliers=outliers, **lag)  # type: ignore[arg-type]
        self.wrong: set[int] = set()

    def grow(self, poses: int, wrong: set[int]) -> None:
        graph, sigmas = self.graph, SIGMAS[used(self.dimension)]
        for k in range(len(graph), len(graph) + poses):
            graph.add_between(k - 1, k, noisy(self.rng, STEP, self.dimension), sigmas=sigmas)
            if k >= LAP and k % 2 == 0:
                graph.add_between(k, k - LAP, noisy(self.rng, np.eye(4), self.dimension), sigmas=sigmas)
            if k in wrong:
                self.wrong.add(graph.add_between(k, k - LAP // 2, WRONG, sigmas=sigmas))
            self.solver.update()

    def clean(self) -> np.ndarray:
        graph = self.graph.copy()
        for number in self.wrong:
            graph.remove(number)
        return graph.optimize().poses


def rmse(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.sqrt(((a[:, :3, 3] - b[:, :3, 3]) ** 2).sum(axis=1).mean()))


@pytest.mark.parametrize(
    ("dimension", "backend", "outliers"),
    [(2, "incremental", "chi2"), (3, "fixed-lag", "chi2"), (2, "incremental", "gnc")],
)
def test_wrong_loops_are_left_out_as_they_come(rng, dimension, backend, outliers):
    laps = Laps(rng, dimension, backend, outliers)
    laps.grow(50, wrong={31, 39, 45})
    assert laps.solver.rejected == laps.wrong
    assert rmse(laps.solver.poses, laps.clean()) < 0.02
    assert rmse(laps.graph.optimize().poses, laps.clean()) > 0.1  # what they would do


def test_gnc_takes_back_a_wrong_loop_that_came_first():
    """Before any other loop, nothing speaks against it."""
    found = {}
    for outliers in ("chi2", "gnc"):
        laps = Laps(np.random.default_rng(5), 2, "incremental", outliers)
        laps.grow(19, wrong=set())
        # within the covariance of 19 steps at a glance, and wrong by a metre
        off = laps.solver.pose(0) @ se3.exp([0, 0, 0.05, 0.5, 0.5, 0.0])
        laps.wrong.add(laps.graph.add_between(19, 0, se3.between(laps.solver.pose(19), off), sigmas=1e-3))
        laps.solver.update()
        assert not laps.solver.rejected
        laps.grow(21, wrong=set())
        laps.solver.update()
        found[outliers] = laps
    assert not found["chi2"].wrong <= found["chi2"].solver.rejected
    assert found["gnc"].solver.rejected == found["gnc"].wrong
    assert rmse(found["gnc"].solver.poses, found["gnc"].clean()) < 0.01


def test_an_update_without_changes_ends_where_optimize_does(rng):
    laps = Laps(rng, 2, "incremental", "gnc")
    laps.grow(40, wrong={25, 31})
    laps.solver.update()
    batch = laps.graph.optimize("gnc")
    assert laps.solver.rejected == batch.rejected
    assert rmse(laps.solver.poses, batch.poses) < 1e-3


def test_chi2_leaves_out_a_fix_that_is_off(rng):
    graph = PoseGraph()
    graph.add_prior(0, np.eye(4), sigmas=1e-3)
    solver, wrong = graph.online(outliers="chi2"), set()
    T = np.eye(4)
    for k in range(1, 30):
        T = T @ STEP
        graph.add_between(k - 1, k, noisy(rng, STEP, 3), sigmas=SIGMAS)
        off = np.array([0.0, 5.0, 0.0]) if k % 10 == 0 else np.zeros(3)
        number = graph.add_gps(k, T[:3, 3] + off + 0.05 * rng.standard_normal(3), 0.05)
        wrong |= {number} if k % 10 == 0 else set()
        solver.update()
    assert solver.rejected == wrong


def test_rejected_and_believed_factors_can_be_removed_and_noise_changed(rng):
    laps = Laps(rng, 3, "incremental", "gnc")
    laps.grow(40, wrong={31})
    (wrong,) = laps.wrong
    laps.graph.remove(wrong)
    (prior,) = (n for n, factor in laps.graph.factors.items() if factor.kind == "prior")
    laps.graph.set_noise(prior, sigmas=2e-3)
    laps.solver.update()
    assert not laps.solver.rejected
    np.testing.assert_allclose(laps.solver.poses, laps.graph.optimize().poses, atol=2e-3)


def test_a_loop_that_alone_places_a_pose_is_believed(rng):
    laps = Laps(rng, 3, "incremental", "chi2")
    laps.grow(30, wrong=set())
    laps.graph.add_between(5, 100, WRONG, sigmas=0.1)
    laps.solver.update()
    np.testing.assert_allclose(laps.solver.pose(5) @ WRONG, laps.solver.pose(100), atol=1e-6)


def test_a_graph_that_is_not_complete_is_refused_and_taken_when_it_is(rng):
    laps = Laps(rng, 3, "incremental", "chi2")
    laps.grow(30, wrong=set())
    laps.graph.add_pose(100)
    wrong = laps.graph.add_between(29, 2, WRONG, sigmas=0.01)
    with pytest.raises(GraphError, match="100"):
        laps.solver.update()
    laps.graph.add_between(30, 100, STEP, sigmas=0.1)
    laps.solver.update()
    assert laps.solver.rejected == {wrong}
    assert 100 in laps.solver


def test_a_lag_forgets_rejected_factors_with_their_poses(rng):
    laps = Laps(rng, 3, "fixed-lag", "chi2", lag=25, forget=True)
    laps.grow(34, wrong={31})
    assert laps.solver.rejected == laps.wrong
    laps.grow(40, wrong=set())
    assert not laps.solver.rejected
    assert len(laps.graph.factors) < 80
    laps.graph.add_between(74, 3, np.eye(4), sigmas=0.1)
    with pytest.raises(GraphError, match="has left the lag"):
        laps.solver.update()


def test_impossible_tests_are_refused():
    graph = PoseGraph()
    with pytest.raises(ConfigError, match="needs the incremental backend"):
        graph.online("fixed-lag", outliers="gnc")
    with pytest.raises(ConfigError, match="unknown test of outliers 'pcm'; choose one of chi2, gnc"):
        graph.online(outliers="pcm")  # type: ignore[arg-type]
