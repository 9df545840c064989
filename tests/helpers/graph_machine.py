"""Random use of PoseGraph and its online solver, as a state machine of hypothesis.

Measurements follow a true path with small noise, so that there is one optimum, which batch and online solvers must find
alike. A model beside the graph, sets of keys and ids, says what the graph must hold.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

import hypothesis
import numpy as np
from graph_calls import CALLS, ODD, content
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)  # fmt: skip

from hybridlio.core import se3
from hybridlio.core.errors import GraphError, HybridLioError
from hybridlio.graph import PoseGraph

KEYS = st.integers(0, 11)
SEEDS = st.integers(0, 2**31)
# A solver linearises anew where a pose has moved by its thresholds; what a graph hardly determines, it may miss by a
# small part of a standard deviation.
AGREEMENT, AGREEMENT_SIGMAS = 0.05, 0.1  # m and rad
steps: Counter[str] = Counter()  # of this process, by what was done


def run(seed: int, examples: int) -> None:
    """Run the machine in a number of histories of up to 50 steps."""
    machine = type(f"GraphMachine{seed}", (GraphMachine,), {})  # hypothesis keeps settings and seed with the class
    settled = settings(
        max_examples=examples, stateful_step_count=50, deadline=None, database=None,
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    run_state_machine_as_test(hypothesis.seed(seed)(machine), settings=settled)


def check_agreement(poses: Any, solution: Any) -> None:
    """Check that an online solver's poses are those of a batch, in metres and radians or in standard deviations."""
    off = se3.log(se3.between(solution.poses, poses))
    for key, pose_off in zip(solution.keys, off, strict=True):
        if np.abs(pose_off).max() >= AGREEMENT:
            pose_off = pose_off if solution.covariance(key).shape == (6, 6) else pose_off[2:5]
            sigmas = np.sqrt(np.diag(solution.covariance(key)))
            assert (np.abs(pose_off) < np.maximum(AGREEMENT, AGREEMENT_SIGMAS * sigmas)).all(), (key, pose_off, sigmas)


def truth(key: int) -> Any:
    """Return the true pose of a key: a curve in the plane, on which heading changes by less than a turn."""
    return se3.exp([0, 0, 0.3 * key, 0, 0, 0]) @ se3.exp([0, 0, 0, 2.0 + key, 0.5 * key, 0])


class GraphMachine(RuleBasedStateMachine):
    """One graph, perhaps with an online solver that follows it, and what it must hold."""

    @initialize(dimension=st.sampled_from([3, 3, 2]))
    def start(self, dimension: Any) -> None:
        self.graph = PoseGraph(dimension)
        self.keys: set[int] = set()
        self.ids: dict[int, set[int]] = {}  # keys of each factor
        self.points: set[int] = set()
        self.solver: Any = None
        self.followed = True  # whether the solver can follow: no pose was removed since it was made

    # helpers

    def sigmas(self) -> Any:
        return np.full(6 if self.graph.dimension == 3 else 3, 0.05)

    def noisy(self, T: Any, seed: int) -> Any:
        xi = np.random.default_rng(seed).normal(0, 0.01, 6)
        if self.graph.dimension == 2:
            xi[[0, 1, 5]] = 0
        return T @ se3.exp(xi)

    def between(self, i: int, j: int, seed: int) -> Any:
        return self.noisy(se3.between(truth(i), truth(j)), seed)

    def known(self, key: int) -> int:
        """Return a pose that the graph has, chosen by any key."""
        return sorted(self.keys)[key % len(self.keys)]

    has_poses = precondition(lambda self: self.keys)
    has_factors = precondition(lambda self: self.ids)

    # adding

    @rule(key=KEYS, seed=SEEDS, is_placed=st.booleans())
    def add_pose(self, key: int, seed: int, is_placed: bool) -> None:
        before = content(self.graph)
        try:
            self.graph.add_pose(key, self.noisy(truth(key), seed) if is_placed else None)
        except GraphError:
            assert key in self.keys
            assert content(self.graph) == before
        else:
            assert key not in self.keys
            self.keys.add(key)

    @rule(key=KEYS, seed=SEEDS, robust=st.sampled_from([None, "huber"]))
    def add_prior(self, key: int, seed: int, robust: str | None) -> None:
        number = self.graph.add_prior(key, self.noisy(truth(key), seed), sigmas=self.sigmas(), robust=robust)
        self.keys.add(key)
        self.ids[number] = {key}

    @has_poses
    @rule(i=KEYS, j=KEYS, seed=SEEDS, robust=st.sampled_from([None, None, "cauchy"]))
    def add_between(self, i: int, j: int, seed: int, robust: str | None) -> None:
        i, before = self.known(i), content(self.graph)
        try:
            number = self.graph.add_between(i, j, self.between(i, j, seed), sigmas=self.sigmas(), robust=robust)
        except GraphError:
            assert i == j
            assert content(self.graph) == before
        else:
            self.keys.add(j)
            self.ids[number] = {i, j}

    @has_poses
    @rule(key=KEYS, kind=st.sampled_from(["gps", "attitude", "altitude", "heading", "custom", "point"]), seed=SEEDS)
    def add_other(self, key: int, kind: str, seed: int) -> None:
        key, graph, before = self.known(key), self.graph, content(self.graph)
        T = self.noisy(truth(key), seed)
        add = {
            "gps": lambda: graph.add_gps(key, T[: graph.dimension, 3], 0.1),
            "attitude": lambda: graph.add_gravity(key, T[2, :3], 0.01),
            "altitude": lambda: graph.add_altitude(key, T[2, 3], 0.1),
            "heading": lambda: graph.add_heading(key, float(np.arctan2(T[1, 0], T[0, 0])), 0.02),
            "custom": lambda: graph.add_factor(key, lambda P: P[:2, 3] - T[:2, 3], [0.1, 0.1]),
            "point": lambda: self.observe(key, seed),
        }
        try:
            number = add[kind]()
        except GraphError:
            assert graph.dimension == 2
            assert kind in ("attitude", "altitude")
            assert content(graph) == before
        else:
            self.ids[number] = {key}

    def observe(self, key: int, seed: int) -> int:
        landmark = 100 + seed % 3
        point = se3.transform(se3.inverse(self.noisy(truth(key), seed)), np.array([[3.0 + landmark % 3, 20, 0]]))[0]
        self.points.add(landmark)
        return self.graph.add_point_observation(key, landmark, point[: self.graph.dimension], sigmas=0.1)

    # changing

    @has_poses
    @rule(key=KEYS, seed=SEEDS, is_held=st.booleans())
    def fix(self, key: int, seed: int, is_held: bool) -> None:
        key = self.known(key)
        if is_held:
            self.graph.set_initial(key, truth(key))
            self.graph.fix(key)
        else:
            self.graph.set_initial(key, self.noisy(truth(key), seed))
            self.graph.unfix(key)

    @has_factors
    @rule(n=st.integers(0, 99))
    def remove(self, n: int) -> None:
        number = sorted(self.ids)[n % len(self.ids)]
        self.graph.remove(number)
        del self.ids[number]

    @has_factors
    @rule(n=st.integers(0, 99), sigma=st.floats(0.02, 0.2))
    def set_noise(self, n: int, sigma: float) -> None:
        number = sorted(self.ids)[n % len(self.ids)]
        self.ids[self.graph.set_noise(number, sigmas=sigma)] = self.ids.pop(number)

    @has_poses
    @rule(key=KEYS)
    def remove_pose(self, key: int) -> None:
        key = self.known(key)
        self.graph.remove_pose(key)
        self.keys.remove(key)
        self.ids = {n: keys for n, keys in self.ids.items() if key not in keys}
        self.points = set(self.graph.landmarks)  # those without an observation leave
        self.followed = False

    @rule(method=st.sampled_from(["odometry", "spanning-tree", "chordal"]))
    def initialise(self, method: Any) -> None:
        before = content(self.graph)
        try:
            self.graph.initialise(method)
        except GraphError:
            assert content(self.graph) == before

    @rule(name=st.sampled_from(sorted(CALLS)), value=st.sampled_from(range(len(ODD))))
    def call_with_an_odd_argument(self, name: str, value: int) -> None:
        copy, before = self.graph.copy(), content(self.graph)
        assert content(copy) == before
        said = ""
        try:
            CALLS[name](copy, ODD[value])
            copy = self.graph
        except HybridLioError as error:
            said = str(error)
        assert "\n" not in said
        assert content(copy) == before
        assert content(self.graph) == before  # a copy is independent

    # whole graphs

    @rule(is_in_place=st.booleans())
    def copy(self, is_in_place: bool) -> None:
        copy = self.graph.copy()
        assert content(copy) == content(self.graph)
        if is_in_place:
            self.graph, self.solver, self.followed = copy, None, True

    @has_poses
    @rule(chosen=st.sets(KEYS, min_size=1))
    def cut(self, chosen: set[int]) -> None:
        kept = self.keys & chosen
        part = self.graph.subgraph(kept)
        assert set(part.keys) == kept
        assert set(part.factors) == {n for n, keys in self.ids.items() if keys <= kept}

    @rule(seed=SEEDS)
    def merge(self, seed: int) -> None:
        other, before, new = PoseGraph(self.graph.dimension), content(self.graph), {0: 12 + seed % 4, 1: 16}
        other.add_prior(0, truth(new[0]), sigmas=self.sigmas())
        other.add_between(0, 1, self.between(new[0], new[1], seed), sigmas=self.sigmas())
        try:
            ids = self.graph.merge(other, new, np.eye(4))
        except GraphError:
            assert self.keys & set(new.values())
            assert content(self.graph) == before
        else:
            self.keys |= set(new.values())
            self.ids |= {ids[0]: {new[0]}, ids[1]: set(new.values())}

    @rule(ending=st.sampled_from(["npz", "g2o", "graph"]))
    def save_and_load(self, ending: str) -> None:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"graph.{ending}"
            with contextlib.suppress(HybridLioError):  # a user's code, or what a text format cannot hold
                self.graph.save(path)
                if ending == "npz":
                    assert content(PoseGraph.load(path)) == content(self.graph)
                    self.graph, self.solver, self.followed = PoseGraph.load(path), None, True
                elif self.keys:
                    assert set(PoseGraph.load(path).keys) == self.keys

    # solving

    @rule(backend=st.sampled_from(["incremental", "fixed-lag"]))
    def follow(self, backend: Any) -> None:
        self.solver, self.followed = self.graph.online(backend, lag=30), True

    @rule(
        seed=SEEDS, robust=st.sampled_from([None, "huber", "cauchy"]), is_followed=st.sampled_from([False] * 3 + [True])
    )
    def drive(self, seed: int, robust: str | None, is_followed: bool) -> None:
        """Join neighbouring poses and close a loop, so that batch and online solvers have something to solve."""
        self.add_prior(seed % 4, seed, None)
        for k in range(seed % 4, seed % 4 + 8):
            self.add_between(k, k + 1, seed + k, None)
            if is_followed and self.solver is not None:
                self.update()
        self.add_between(seed % 4 + 8, seed % 4, seed, robust)

    @precondition(lambda self: self.solver is not None)
    @rule()
    def update(self) -> None:
        before = content(self.graph)
        try:
            for _ in range(4):  # the first takes over what has changed; each other relinearises what has moved
                self.solver.update()
        except GraphError:
            assert content(self.graph) == before
            assert not self.followed or self.batch() is None, "a batch solves what the online solver refuses"
            return
        assert self.followed, "the solver follows a graph that is no longer there"
        assert self.solver.keys == self.graph.keys
        if self.keys and (solution := self.batch()) is not None:
            check_agreement(self.solver.poses, solution)
            steps["online solver with batch"] += 1

    @rule()
    def solve_in_several_ways(self) -> None:
        before = content(self.graph)
        solution = self.batch()
        if solution is not None:
            start = self.graph.copy()
            for key in self.keys:
                start.set_initial(key, truth(key))
            assert solution.error <= start.optimize(initial="given").error * (1 + 1e-3) + 1e-6
        with contextlib.suppress(GraphError):
            online = self.graph.optimize("incremental")
            assert solution is not None, "an online solver solves what a batch refuses"
            if online.converged:
                check_agreement(online.poses, solution)
            steps["incremental with batch" if online.converged else "incremental has not converged"] += 1
        assert content(self.graph) == before

    def batch(self) -> Any:
        try:
            solution = self.graph.optimize()
        except GraphError:
            return None
        for key in self.keys:
            assert np.isfinite(solution.pose(key)).all()
        return solution

    @invariant()
    def the_graph_holds_what_the_model_says(self) -> None:
        steps["steps"] += 1
        assert set(self.graph.keys) == self.keys
        assert len(self.graph) == len(self.keys)
        assert {n: set(f.keys) for n, f in self.graph.factors.items()} == self.ids
        assert set(self.graph.landmarks) >= self.points
