"""A pose graph solved while it grows: each update costs what it changes, not what is there."""

from __future__ import annotations

from collections.abc import Hashable, Iterable
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import ConfigError, GraphError
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.checks import Chain, chains_without_bias, check_determined
from hybridlio.graph.model.edge_table import Rows
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.model.keys import Key, check_key, named
from hybridlio.graph.solve.build import Builder
from hybridlio.graph.solve.changes import News, Reader
from hybridlio.graph.solve.engines import Engine, FixedLag, Incremental
from hybridlio.graph.solve.levenberg import Descent, biases_of, poses_of, silent
from hybridlio.graph.solve.online_start import Guess, is_reached
from hybridlio.graph.solve.starts import choose_start

ONLINE = ("incremental", "fixed-lag")
_FIRST_ITERATIONS = 100
_SETTLING = 5


class OnlineSolver:
    """Follows a pose graph; :meth:`update` takes in what was added to it or taken out of it.

    ``incremental`` is iSAM2 (Kaess et al., IJRR 2012). ``fixed-lag`` has constant time and memory: a pose that ``lag``
    newer ones came after is marginalised, and stays readable as it was last estimated; no factor may concern it anew.

    Initial values count at a pose's first update only, and only where no factor leads there from poses that are known.
    """

    def __init__(self, graph: GraphData, backend: str, lag: int, forget: bool) -> None:
        if backend not in ONLINE or lag < 1:
            raise ConfigError(f"online solver {backend!r}, lag {lag}: there are {', '.join(ONLINE)}; a lag is positive")
        self._graph, self._reader = graph, Reader(graph)
        self._lag = lag if backend == "fixed-lag" else None
        self._forget = forget and self._lag is not None
        self._engine: Engine = Incremental(graph.dimension) if self._lag is None else FixedLag(graph.dimension, lag)
        self._slots: dict[Hashable, int] = {}  # of factors by id, of what holds a pose or starts a bias by name
        self._moving: set[int] = set()  # places of poses with a velocity
        self._biased: set[int] = set()
        self._carried: set[int] = set()  # those whose biases poses that have left the lag tell
        self._poses = self._oldest = 0
        self._left = Rows(co.IDENTITY[graph.dimension].shape)

    def __len__(self) -> int:
        return self._poses

    def __contains__(self, key: object) -> bool:
        return self._graph.places.get(key, self._poses) < self._poses  # type: ignore[call-overload, no-any-return]

    def update(self) -> None:
        """Take in what is new in the graph since the last update; without news, iterate once more.

        Raises:
            GraphError: what is new does not determine every pose, or concerns one that has left the lag; names the
                keys. The solver then is as before: mend the graph, and update again.
        """
        news = self._reader.read()
        if not news and self._poses:
            self._engine.iterate()
            return
        self._check(news)
        if self._poses:
            guess = Guess(self._graph, news, self._engine.solver, self._moving, self._biased)
            builder, values = guess.builder, guess.values()
        else:
            builder, values = self._first()
        graph, names, dropped = self._factors(builder, news)
        leaving = self._leaving(news, values)
        removed = [self._slots[name] for name in [*news.gone, *dropped]]
        try:
            slots = self._engine.update(graph, values, removed)
        except GraphError:
            moved = self._engine.restore(self._slots.values()) if self._poses else {}
            self._slots = {name: moved[slot] for name, slot in self._slots.items()}
            raise
        ids = set(names)
        for name in [*news.gone, *dropped]:
            del self._slots[name]
        self._slots.update(zip(names, slots, strict=True))
        self._took(news, values, leaving)
        if self._graph.edges.robust.keys() & ids or any(factor.robust for factor in news.others.values()):
            self._settle()

    # what is estimated

    @property
    def keys(self) -> list[Key]:
        """Keys of all poses so far."""
        return self._graph.keys[: self._poses]

    def pose(self, key: Key) -> Array:
        """A pose ``(4, 4)`` in world; one that has left the lag as last estimated."""
        place = self._place(key)
        if place < self._oldest:
            return np.array(co.to_matrices(self._left.array[place][None])[0])
        return np.array(self._pose(place))

    @property
    def poses(self) -> Array:
        """All poses so far ``(N, 4, 4)``."""
        if not self._poses:
            return np.empty((0, 4, 4))
        inside = poses_of(self._engine.solver.calculateEstimate(), self._graph.dimension)
        return co.to_matrices(np.vstack([self._left.array, inside]))

    def values(self) -> gtsam.Values:
        """All as GTSAM has it: poses ``x`` by place, velocities ``v`` and biases ``b`` of those in the lag."""
        values = gtsam.Values(self._engine.solver.calculateEstimate())
        for place, pose in enumerate(co.gtsam_poses(self._left.array)):
            values.insert(X(place), pose)
        return values

    def velocity(self, key: Key) -> Array:
        """The body's velocity ``(3,)`` in world, m/s; GraphError where it has none or has left the lag."""
        variable = V(self._inside(key, self._moving, "velocity"))
        return np.array(self._engine.solver.calculateEstimateVector(variable))

    def bias(self, key: Key) -> tuple[Array, Array]:
        """Biases of accelerometer and gyroscope, ``(3,)`` each; GraphError where it has none or has left the lag."""
        bias = self._engine.solver.calculateEstimateConstantBias(B(self._inside(key, self._biased, "biases")))
        return np.array(bias.accelerometer()), np.array(bias.gyroscope())

    def covariance(self, key: Key) -> Array:
        """Covariance ``(6, 6)`` of a pose in the lag; as :meth:`hybridlio.graph.solve.solution.Solution.covariance`."""
        place = self._inside(key)
        covariance = self._engine.solver.marginalCovariance(X(place))
        return co.our_order((covariance + covariance.T) / 2, self._graph.dimension)

    def relative_covariance(self, i: Key, j: Key) -> Array:
        """As :meth:`~hybridlio.graph.solve.solution.Solution.relative_covariance`; of poses in the lag only."""
        a, b = self._inside(i), self._inside(j)
        if a == b:
            return np.zeros((co.TANGENT_SIZE[self._graph.dimension],) * 2)
        T_j_i = se3.between(self._pose(b), self._pose(a))
        return co.relative_covariance(self._engine.joint([X(a), X(b)]), X(a), X(b), T_j_i, self._graph.dimension)

    # inside

    def _settle(self) -> None:
        """Iterate: a kernel's weight is that of the residual at the last linearisation."""
        for _ in range(_SETTLING):
            if not self._engine.iterate():
                return

    def _first(self) -> tuple[Builder, gtsam.Values]:
        """All that is there, solved at once."""
        data = self._graph.without()
        solved = Descent(data, _FIRST_ITERATIONS, 1e-9, silent)(choose_start(data, "auto"))
        return Builder(self._graph, biases_of(solved.values)), solved.values

    def _check(self, news: News) -> None:
        """Raise where the graph with its news is not determined, or reaches behind the lag."""
        left = [number for number in news.gone if number not in self._slots]
        if left:
            self._reader.forget(set(left))
            raise GraphError(f"factor {left[0]} was taken out, but had left the lag; its effect stays")
        self._check_lag(news)
        if not news.gone and not news.freed and self._poses and is_reached(self._graph, news, self._moving):
            return
        if not self._oldest:
            check_determined(self._graph)
        elif not is_reached(self._graph, news, self._moving):
            raise GraphError(f"nothing joins pose {named(self._keys_of(news.poses))} to those in the lag")

    def _check_lag(self, news: News) -> None:
        oldest = max(self._oldest, news.poses.stop - 1 - self._lag) if self._lag is not None and self._poses else 0
        if not oldest:
            return
        edges = self._graph.edges.ids[news.rows].tolist()
        for factor in [*(self._graph.factors[number] for number in edges), *news.others.values()]:
            left = [key for key in factor.keys if self._graph.places[key] < oldest]
            if left:
                raise GraphError(f"{factor.label}: pose {named(left)} has left the lag of {self._lag} poses")

    def _factors(self, builder: Builder, news: News) -> tuple[Any, list[Hashable], list[Hashable]]:
        """New factors for GTSAM with their names, and the names of those that no longer hold."""
        graph, names = gtsam.NonlinearFactorGraph(), list[Hashable]()
        ids = self._graph.edges.ids[news.rows].tolist()
        found = list(zip(ids, builder.edges(news.rows), strict=True))
        found += [(number, builder.other(factor)) for number, factor in news.others.items()]
        found += [(("held", key), builder.held(key)) for key in news.fixed]
        dropped: list[Hashable] = [("held", key) for key in news.freed if ("held", key) in self._slots]
        if any(factor.kind in ("imu", "bias") for factor in news.others.values()):
            starts, ended = self._bias_starts()
            found += [(("start", chain.start), builder.bias_start(chain.start, chain.noise)) for chain in starts]
            dropped += ended
        for name, factor in found:
            names.append(name)
            graph.add(factor)
        return graph, names, dropped

    def _bias_starts(self) -> tuple[list[Chain], list[Hashable]]:
        """Chains whose biases have yet to be started, and names of the starts that something else has replaced."""
        chains = chains_without_bias(self._graph)
        wanted = {("start", chain.start) for chain in chains}
        have = {name for name in self._slots if isinstance(name, tuple) and name[0] == "start"}
        places = self._graph.places
        unknown = [chain for chain in chains if not any(places[key] in self._carried for key in chain.keys)]
        return [chain for chain in unknown if ("start", chain.start) not in have], list(have - wanted)

    def _leaving(self, news: News, values: gtsam.Values) -> Array:
        """Coordinates of the poses that this update marginalises, as they are before it."""
        oldest = 0 if self._lag is None else max(news.poses.stop - 1 - self._lag, self._oldest)
        out = gtsam.Values()
        for place in range(self._oldest, oldest):
            known = place < self._poses
            out.insert(X(place), self._gtsam_pose(self._engine.solver if known else values, place, known))
        return poses_of(out, self._graph.dimension)

    def _gtsam_pose(self, source: Any, place: int, estimated: bool) -> Any:
        kind = "Pose3" if self._graph.dimension == 3 else "Pose2"
        return getattr(source, f"{'calculateEstimate' if estimated else 'at'}{kind}")(X(place))

    def _took(self, news: News, values: gtsam.Values, leaving: Array) -> None:
        self._reader.took(news)
        self._poses = news.poses.stop
        variables = values.keys() if news.others else []
        for variable in variables:
            symbol = gtsam.Symbol(variable)
            if symbol.chr() == ord("v"):
                self._moving.add(symbol.index())
            elif symbol.chr() == ord("b"):
                self._biased.add(symbol.index())
        if len(leaving):
            self._leave(leaving)

    def _leave(self, leaving: Array) -> None:
        """Count poses as marginalised, with the factors that concern them."""
        self._left.extend(leaving)
        places = range(self._oldest, self._oldest + len(leaving))
        self._oldest = places.stop
        self._moving.difference_update(places)
        self._biased.difference_update(places)
        gone = self._graph.concerning(places)
        self._carry_biases(gone)
        for key in self._graph.keys_at(places):
            self._slots.pop(("held", key), None)
            self._slots.pop(("start", key), None)
        for number in gone:
            self._slots.pop(number, None)
        if self._forget:
            self._graph.drop(gone, places, leaving)
            self._reader.forget(gone)

    def _carry_biases(self, gone: Iterable[int]) -> None:
        """Know the poses whose biases those that have left the lag tell: no start may tell them again."""
        left = [self._graph.others[number] for number in gone if number in self._graph.others]
        places = {self._graph.places[key] for factor in left if factor.kind == "imu" for key in factor.keys}
        self._carried = {place for place in self._carried | places if place >= self._oldest}

    def _keys_of(self, places: range) -> list[Key]:
        return self._graph.keys_at(places)

    def _pose(self, place: int) -> Array:
        found = self._gtsam_pose(self._engine.solver, place, True)
        if self._graph.dimension == 3:
            return np.asarray(found.matrix())
        return np.asarray(co.to_matrices(np.array([[found.x(), found.y(), found.theta()]]))[0])

    def _place(self, key: Key) -> int:
        place = self._graph.places.get(check_key(key), self._poses)
        if place >= self._poses:
            raise GraphError(f"no update has brought a pose of key {key}")
        return place

    def _inside(self, key: Key, among: set[int] | None = None, what: str = "") -> int:
        place = self._place(key)
        if place < self._oldest:
            raise GraphError(f"pose {key} has left the lag of {self._lag} poses; only where it was is known")
        if among is not None and place not in among:
            raise GraphError(f"pose {key} has no {what}; inertial and velocity factors give them")
        return place
