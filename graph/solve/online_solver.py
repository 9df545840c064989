"""A pose graph solved while it grows: an update costs what it changes, not what the graph holds."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import GraphError
from hybridlio.graph.base.deep_stack import on_deep_stack
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.checks import check_determined
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.model.growing_array import GrowingArray
from hybridlio.graph.model.keys import Key, check_key, list_keys
from hybridlio.graph.solve.builder import Builder
from hybridlio.graph.solve.changes import Changes, ChangeTracker
from hybridlio.graph.solve.engines import Engine, FixedLag, Incremental
from hybridlio.graph.solve.initial_values import choose_start
from hybridlio.graph.solve.landmark_factors import insert_landmarks
from hybridlio.graph.solve.linear_solver import poses_of
from hybridlio.graph.solve.nonlinear import NonlinearSolver, biases_of
from hybridlio.graph.solve.online_factors import new_factors
from hybridlio.graph.solve.online_held import HeldFactors
from hybridlio.graph.solve.online_landmarks import OnlineLandmarks
from hybridlio.graph.solve.online_start import OnlineStart, determines_new_poses
from hybridlio.graph.solve.settings import ONLINE_SOLVERS, check_choice, check_count, silent

_FIRST_ITERATIONS = 100  # as PoseGraph.optimize by default
_FIRST_TOLERANCE = 1e-9  # of the error: the first update's result is iSAM2's linearisation point, so solve it exactly


class OnlineSolver:
    """Follows a pose graph: :meth:`update` takes over what was added to it or removed from it.

    ``incremental`` is iSAM2 (Kaess et al., IJRR 2012). ``fixed-lag`` takes constant time and memory: a pose is
    marginalised when ``lag`` newer ones exist. It stays readable as last estimated, but takes no new factors.

    A pose's initial value is used once, at its first update, and only where no factor leads to it from a known pose.
    """

    def __init__(self, data: GraphData, backend: str, lag: int, forget: bool) -> None:
        check_choice("online backend", backend, ONLINE_SOLVERS)
        check_count("lag", lag)
        self._data, self._tracker = data, ChangeTracker(data)
        self._lag = lag if backend == "fixed-lag" else None
        self._forget = forget and self._lag is not None
        self._engine: Engine = Incremental(data.dimension) if self._lag is None else FixedLag(data.dimension, lag)
        self._held = HeldFactors(self._engine, data.dimension)
        self._with_velocity: set[int] = set()  # indices of poses in the lag whose velocity is a variable
        self._with_bias: set[int] = set()
        self._bias_marginalised: set[int] = set()  # poses in the lag whose biases a marginal constrains
        self._landmarks = OnlineLandmarks(data)
        self._count = self._oldest = 0  # poses so far; index of the oldest one in the lag
        self._departed = GrowingArray(co.IDENTITY[data.dimension].shape)  # poses that left the lag, as last estimated

    def __len__(self) -> int:
        return self._count

    def __contains__(self, key: object) -> bool:
        return self._data.index.get(key, self._count) < self._count  # type: ignore[call-overload, no-any-return]

    def update(self) -> None:
        """Take over the graph's changes since the last update; without changes, iterate once more.

        Raises:
            GraphError: the changes do not determine every pose, or concern one that has left the lag; names the keys.
                The solver is then as before: correct the graph and update again. Or a pose was removed.
        """
        self._check_not_replaced(self._data)
        on_deep_stack(len(self._data), self._update)

    def _update(self) -> None:
        changes = self._tracker.read()
        if not changes and self._count:
            self._held.iterate()
            return
        self._check(changes)
        if self._count:
            solver, landmarks = self._engine.solver, self._landmarks.estimated
            start = OnlineStart(self._data, changes, solver, self._with_velocity, self._with_bias, landmarks)
            builder, values = start.builder, start.values()
        else:
            builder, values = self._solve_first()
        factors = new_factors(builder, changes, self._held.names, self._bias_marginalised)
        leaving, latest = self._leaving(changes, values), self._landmarks.latest(changes.other_factors.values())
        leaving_points = self._landmarks.leaving(latest, self._oldest_after(changes), self._engine.solver)
        self._held.update(factors, values, changes.removed, latest)
        self._accept(changes, values, leaving)
        self._landmarks.accept(latest, leaving_points)
        self._held.settle(far=bool(changes.removed) or self._closes_loops(changes))

    @property
    def rejected(self) -> frozenset[int]:
        """Ids of the factors that are not believed; empty without ``outliers=``."""
        return frozenset()

    @property
    def doubtful(self) -> tuple[str, ...]:
        """Reasons why the last search for wrong loops may be wrong; empty without ``outliers="gnc"``."""
        return ()

    # estimates

    @property
    def keys(self) -> list[Key]:
        """Keys of all poses so far."""
        return self._data.keys[: self._count]

    def pose(self, key: Key) -> Array:
        """Return a pose ``(4, 4)`` in world; one that has left the lag as last estimated."""
        index = self._known(key)
        if index < self._oldest:
            return np.array(co.to_matrices(self._departed.array[index][None])[0])
        return np.array(self._estimate(index))

    @property
    def poses(self) -> Array:
        """All poses so far ``(N, 4, 4)``."""
        if not self._count:
            return np.empty((0, 4, 4))
        in_lag = poses_of(self._engine.solver.calculateEstimate(), self._data.dimension)
        return co.to_matrices(np.vstack([self._departed.array, in_lag]))

    def values(self) -> gtsam.Values:
        """Return GTSAM's values: poses ``x``, landmarks ``l``, and velocities ``v`` and biases ``b`` in the lag."""
        values = gtsam.Values(self._engine.solver.calculateEstimate())
        for index, pose in enumerate(co.gtsam_poses(self._departed.array)):
            values.insert(X(index), pose)
        insert_landmarks(values, self._landmarks.departed)
        return values

    def point(self, key: Key) -> Array:
        """Return a landmark ``(3,)`` in world, ``(2,)`` in the plane; one that has left the lag as last estimated."""
        return self._landmarks.point(check_key(key), self._engine.solver)

    def velocity(self, key: Key) -> Array:
        """Return the body's velocity ``(3,)`` in world, m/s; GraphError where it has none or has left the lag."""
        variable = V(self._in_lag(key, self._with_velocity, "velocity"))
        return np.array(self._engine.solver.calculateEstimateVector(variable))

    def bias(self, key: Key) -> tuple[Array, Array]:
        """Return the biases of accelerometer (m/s²) and gyroscope (rad/s); GraphError as for :meth:`velocity`."""
        bias = self._engine.solver.calculateEstimateConstantBias(B(self._in_lag(key, self._with_bias, "biases")))
        return np.array(bias.accelerometer()), np.array(bias.gyroscope())

    def covariance(self, key: Key) -> Array:
        """Return the covariance of a pose or a landmark, as a solution does; only in the lag."""
        if (key := check_key(key)) in self._data.landmarks:
            covariance = self._marginal(self._landmarks.variable(key))
            return np.asarray((covariance + covariance.T) / 2)
        index = self._in_lag(key)
        covariance = self._marginal(X(index))
        return co.our_order((covariance + covariance.T) / 2, self._data.dimension)

    def relative_covariance(self, i: Key, j: Key) -> Array:
        """Return the covariance of pose j in the frame of pose i, as a solution does; only in the lag."""
        a, b = self._in_lag(i), self._in_lag(j)
        if a == b:
            return np.zeros((self._data.tangent_size,) * 2)
        T_j_i = se3.between(self._estimate(b), self._estimate(a))
        joint = on_deep_stack(len(self), lambda: self._engine.joint([X(a), X(b)])).fullMatrix()
        return co.relative_covariance(joint, T_j_i, self._data.dimension)

    def _marginal(self, variable: int) -> Array:
        return on_deep_stack(len(self), lambda: np.asarray(self._engine.solver.marginalCovariance(variable)))

    # one update

    def _closes_loops(self, changes: Changes) -> bool:
        """Return whether a new edge joins poses that are not neighbours, and may so move those between them."""
        ends = self._data.edges.ends[changes.edge_rows]
        return bool((np.abs(ends[:, 0] - ends[:, 1]) > 1).any())

    def _solve_first(self) -> tuple[Builder, gtsam.Values]:
        """Solve the whole graph of the first update as a batch."""
        data = self._data.copy()
        solve = NonlinearSolver(data, _FIRST_ITERATIONS, _FIRST_TOLERANCE, silent)
        values = solve(choose_start(data, "auto")).values
        return Builder(self._data, biases_of(values)), values

    @staticmethod
    def _check_not_replaced(data: GraphData) -> None:
        if data.is_replaced:
            raise GraphError("a pose was removed from the graph, which no solver follows; make a new one by online()")

    def _check(self, changes: Changes) -> None:
        """Check that the changed graph is determined, and that no change concerns poses that left the lag."""
        marginalised = [factor_id for factor_id in changes.removed if factor_id not in self._held.names]
        if marginalised:
            self._tracker.forget(set(marginalised))
            raise GraphError(
                f"factor {marginalised[0]} was removed after its poses had left the lag; its effect remains"
            )
        self._check_lag(changes)
        self._landmarks.check(changes.other_factors.values(), bool(changes.removed))
        determined = self._count and determines_new_poses(self._data, changes, self._with_velocity)
        if determined and not changes.removed and not changes.unfixed:
            return
        if not self._oldest:
            check_determined(self._data)
        elif not determined:
            raise GraphError(
                f"no factor joins pose {list_keys(self._data.keys_at(changes.poses))} to a pose in the lag"
            )

    def _check_lag(self, changes: Changes) -> None:
        oldest = self._oldest_after(changes) if self._count else 0
        if not oldest:
            return
        edges = self._data.edges.ids[changes.edge_rows].tolist()
        for factor in [*(self._data.factors[n] for n in edges), *changes.other_factors.values()]:
            left = [key for key in factor.keys if self._data.index[key] < oldest]
            if left:
                raise GraphError(f"{factor.label}: pose {list_keys(left)} has left the lag of {self._lag} poses")

    def _oldest_after(self, changes: Changes) -> int:
        """Return the index of the oldest pose in the lag once the changes are in."""
        return 0 if self._lag is None else max(changes.poses.stop - 1 - self._lag, self._oldest)

    # the lag

    def _leaving(self, changes: Changes, values: gtsam.Values) -> Array:
        """Return coordinates of the poses that this update marginalises, from before it."""
        out = gtsam.Values()
        for index in range(self._oldest, self._oldest_after(changes)):
            estimated = index < self._count
            out.insert(X(index), self._gtsam_pose(self._engine.solver if estimated else values, index, estimated))
        return poses_of(out, self._data.dimension)

    def _accept(self, changes: Changes, values: gtsam.Values, leaving: Array) -> None:
        """Count the changes as taken over."""
        self._tracker.accept(changes)
        self._count = changes.poses.stop
        variables = values.keys() if changes.other_factors else []
        for variable in variables:
            symbol = gtsam.Symbol(variable)
            if symbol.chr() == ord("v"):
                self._with_velocity.add(symbol.index())
            elif symbol.chr() == ord("b"):
                self._with_bias.add(symbol.index())
        if len(leaving):
            self._marginalise(leaving)

    def _marginalise(self, leaving: Array) -> None:
        """Count poses as marginalised, with the factors that concern them."""
        self._departed.extend(leaving)
        poses = range(self._oldest, self._oldest + len(leaving))
        self._oldest = poses.stop
        self._with_velocity.difference_update(poses)
        self._with_bias.difference_update(poses)
        ids = self._data.factor_ids_of(poses)
        self._note_marginalised_biases(ids)
        self._held.forget([*ids, *((kind, key) for key in self._data.keys_at(poses) for kind in ("fixed", "bias"))])
        if self._forget:
            self._forget_factors(ids, poses, leaving)

    def _forget_factors(self, ids: set[int], poses: range, leaving: Array) -> None:
        """Remove marginalised factors from the graph."""
        self._data.forget(ids, poses, leaving)
        self._tracker.forget(ids)

    def _note_marginalised_biases(self, ids: Iterable[int]) -> None:
        """Note the poses whose biases marginalised samples constrain: no prior of first biases may be added there."""
        factors = [self._data.other_factors[n] for n in ids if n in self._data.other_factors]
        joined = {self._data.index[key] for factor in factors if factor.kind == "imu" for key in factor.keys}
        self._bias_marginalised = {k for k in self._bias_marginalised | joined if k >= self._oldest}

    def _gtsam_pose(self, source: Any, index: int, estimated: bool) -> Any:
        kind = "Pose3" if self._data.dimension == 3 else "Pose2"
        return getattr(source, f"{'calculateEstimate' if estimated else 'at'}{kind}")(X(index))

    def _estimate(self, index: int) -> Array:
        pose = self._gtsam_pose(self._engine.solver, index, True)
        if self._data.dimension == 3:
            return np.asarray(pose.matrix())
        return np.asarray(co.to_matrices(np.array([[pose.x(), pose.y(), pose.theta()]]))[0])

    def _known(self, key: Key) -> int:
        index = self._data.index.get(check_key(key), self._count)
        if index >= self._count:
            raise GraphError(f"no update has added a pose with key {key}")
        return index

    def _in_lag(self, key: Key, among: set[int] | None = None, what: str = "") -> int:
        index = self._known(key)
        if index < self._oldest:
            raise GraphError(f"pose {key} has left the lag of {self._lag} poses; only its last estimate is known")
        if among is not None and index not in among:
            raise GraphError(f"pose {key} has no {what}; inertial and velocity factors add them")
        return index
