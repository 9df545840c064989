"""Initial values of the variables that an update of an online solver adds, and whether its factors determine them."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from hybridlio.core.arrays import Array
from hybridlio.core.errors import GraphError
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.model.keys import list_keys
from hybridlio.graph.model.measurements import OBSERVATIONS, VELOCITIES, Factor
from hybridlio.graph.solve.builder import Builder
from hybridlio.graph.solve.changes import Changes
from hybridlio.graph.solve.landmark_factors import insert_landmarks, point_in_pose_frame


def determines_new_poses(data: GraphData, changes: Changes, with_velocity: set[int]) -> bool:
    """Return whether the new factors lead from estimated poses or priors to every new pose and its velocity.

    A quick, sufficient test from the changes alone; :func:`hybridlio.graph.model.checks.check_determined` looks at the
    whole graph.

    Args:
        data: the graph.
        changes: since the last update.
        with_velocity: indices of the poses whose velocity is estimated.
    """
    index = data.index
    placed = {index[f.keys[0]] for f in changes.of_kind("prior")} | {index[key] for key in changes.fixed}
    moving = {index[f.keys[0]] for f in changes.of_kind(*VELOCITIES)} | with_velocity
    reach = _Reach(changes.poses.start, placed, moving)
    edges = data.edges.ends[changes.edge_rows].tolist()
    inertial = [(index[f.keys[0]], index[f.keys[1]]) for f in changes.of_kind("imu")]
    while reach.grow(edges, inertial):
        pass
    return all(reach.velocities.issuperset(ends) for ends in inertial) and reach.poses.issuperset(changes.poses)


class _Reach:
    """New poses, and velocities of any, that factors determine so far."""

    def __init__(self, first_new: int, poses: set[int], velocities: set[int]) -> None:
        self._first_new, self.poses, self.velocities = first_new, poses, velocities

    def grow(self, edges: list[list[int]], inertial: list[tuple[int, int]]) -> bool:
        """Follow each factor once; return whether any led further."""
        before = len(self.poses), len(self.velocities)
        for i, j in edges:
            if self._has_pose(i) or self._has_pose(j):
                self.poses |= {i, j}
        for i, j in inertial:
            self._follow_samples(i, j)
        return before != (len(self.poses), len(self.velocities))

    def _follow_samples(self, i: int, j: int) -> None:
        if any(self._has_pose(k) and k in self.velocities for k in (i, j)):
            self.poses |= {i, j}
        if not self.velocities.isdisjoint((i, j)):
            self.velocities |= {i, j}

    def _has_pose(self, index: int) -> bool:
        return index < self._first_new or index in self.poses


def follow_factors(data: GraphData) -> Array:
    """Return coordinates ``(N, 7)`` or ``(N, 3)`` of all poses of a graph, as the first update of an online solver.

    They follow between-factors and inertial samples from priors, fixed poses and given initial values.

    Raises:
        GraphError: no factor leads to a pose and it has no initial value; names it.
    """
    changes = Changes(range(len(data)), slice(0, len(data.edges)), dict(data.other_factors), [], list(data.fixed), [])
    return OnlineStart(data, changes, None, set(), set(), set()).poses()


class OnlineStart:
    """Initial values of new variables: along the new factors from estimated poses, else as given by the user.

    Args:
        data: the graph.
        changes: since the last update.
        solver: GTSAM's solver with the estimates so far.
        with_velocity: indices of the poses whose velocity it estimates.
        with_bias: indices of the poses whose biases it estimates.
        landmarks: indices of the landmarks that it estimates.

    Attributes:
        builder: makes factors, with IMU samples preintegrated around :meth:`bias`.
    """

    def __init__(
        self, data: GraphData, changes: Changes, solver: Any, with_velocity: set[int], with_bias: set[int],
        landmarks: set[int],
    ) -> None:  # fmt: skip
        self._data, self._changes, self._solver = data, changes, solver
        self._with_velocity, self._with_bias, self._landmarks = with_velocity, with_bias, landmarks
        self._poses: dict[int, Any] = {}
        self._velocities: dict[int, Any] = {}
        self._biases = {data.index[f.keys[0]]: f.measured for f in changes.of_kind("bias")}
        self.builder = Builder(data, lambda variable: self.bias(gtsam.Symbol(variable).index()))

    def bias(self, index: int) -> gtsam.imuBias.ConstantBias:
        """Return a pose's biases, around which samples are preintegrated: estimated, else measured, else zero."""
        if index in self._with_bias:
            estimated: gtsam.imuBias.ConstantBias = self._solver.calculateEstimateConstantBias(B(index))
            return estimated
        measured = self._biases.get(index, np.zeros(6))
        return gtsam.imuBias.ConstantBias(measured[:3], measured[3:])

    def values(self) -> gtsam.Values:
        """Return initial values of all new variables.

        Raises:
            GraphError: no factor leads to a new pose and it has no initial value; names it.
        """
        inertial = self._changes.of_kind("imu")
        self._pass_biases_on(inertial)
        self._follow(inertial)
        self._use_given(inertial)
        values = gtsam.Values()
        for index, pose in sorted(self._poses.items()):
            values.insert(X(index), pose)
        self._insert_motion(values, inertial)
        insert_landmarks(values, self._new_landmarks())
        return values

    def poses(self) -> Array:
        """Return the coordinates ``(N, 7)`` or ``(N, 3)`` of all new poses; errors as for :meth:`values`."""
        self.values()
        placed = [self._poses[k] for k in range(len(self._data))]
        if self._data.dimension == 2:
            return np.array([[pose.x(), pose.y(), pose.theta()] for pose in placed])
        return co.from_matrices(np.array([pose.matrix() for pose in placed]), 3)

    def _new_landmarks(self) -> dict[int, Array]:
        """Return the points of new landmarks, by index, where their first observation sees them."""
        found: dict[int, Array] = {}
        for factor in self._changes.of_kind(*OBSERVATIONS):
            assert factor.landmark is not None
            landmark = self._data.landmarks.index[factor.landmark]
            if landmark not in self._landmarks and landmark not in found:
                pose = self._pose(self._data.index[factor.keys[0]])
                found[landmark] = np.array(pose.transformFrom(point_in_pose_frame(factor)))
        return found

    def _pass_biases_on(self, inertial: list[Factor]) -> None:
        """Start the biases of each IMU factor's second pose at those of its first."""
        for factor in inertial:
            i, j = (self._data.index[key] for key in factor.keys)
            if j not in self._biases and j not in self._with_bias:
                self._biases[j] = self.bias(i).vector()

    def _pose(self, index: int) -> Any:
        """Return a pose as GTSAM's, or None where it is not known yet."""
        if index < self._changes.poses.start:
            kind = "Pose3" if self._data.dimension == 3 else "Pose2"
            return getattr(self._solver, f"calculateEstimate{kind}")(X(index))
        return self._poses.get(index)

    def _follow(self, inertial: list[Factor]) -> None:
        """Place new poses along edges and samples, until neither leads further."""
        known = -1
        while known < (known := len(self._poses)):
            self._follow_edges()
            for factor in inertial:
                self._predict(factor)

    def _follow_edges(self) -> None:
        """Place new poses along new edges from known ones, until no edge leads further."""
        table, rows = self._data.edges, self._changes.edge_rows
        edges = list(zip(table.ends[rows].tolist(), co.gtsam_poses(table.measured[rows]), strict=True))
        while edges:
            waiting = []
            for (i, j), T_i_j in edges:
                pose_i, pose_j = self._pose(i), self._pose(j)
                if pose_j is None and pose_i is not None:
                    self._poses[j] = pose_i.compose(T_i_j)
                elif pose_i is None and pose_j is not None:
                    self._poses[i] = pose_j.compose(T_i_j.inverse())
                elif pose_i is None:
                    waiting.append(((i, j), T_i_j))
            if len(waiting) == len(edges):
                return
            edges = waiting

    def _predict(self, factor: Factor) -> None:
        """Place the second pose of an IMU factor, and its velocity, by its samples."""
        i, j = (self._data.index[key] for key in factor.keys)
        pose, velocity = self._pose(i), self._velocity(i)
        if pose is None or velocity is None:
            return
        samples = self.builder.factor(factor).preintegratedMeasurements()
        then = samples.predict(gtsam.NavState(pose, velocity), self.bias(i))
        if self._pose(j) is None:
            self._poses[j] = then.pose()
        if j not in self._with_velocity:
            self._velocities[j] = then.velocity()

    def _velocity(self, index: int) -> Any:
        if index in self._with_velocity:
            return self._solver.calculateEstimateVector(V(index))
        if index not in self._velocities:
            for factor in self._changes.of_kind(*VELOCITIES):
                pose = self._pose(index)
                if self._data.index[factor.keys[0]] != index:
                    continue
                if factor.kind == "velocity":
                    self._velocities[index] = factor.measured
                elif pose is not None:
                    self._velocities[index] = pose.rotation().matrix() @ factor.measured
        return self._velocities.get(index)

    def _use_given(self, inertial: list[Factor]) -> None:
        """Place the new poses that no factor led to by their priors or given initial values, priors first."""
        priors = {self._data.index[f.keys[0]]: f.measured for f in self._changes.of_kind("prior")}
        fixed = (self._data.index[key] for key in self._changes.fixed)
        for index in [*priors, *fixed, *self._changes.poses]:
            if index in self._poses or index < self._changes.poses.start:
                continue
            (key,) = self._data.keys_at([index])
            at = priors.get(index, self._data.initial_value(key))
            if at is not None:
                self._poses[index] = co.gtsam_poses(at[None])[0]
                self._follow(inertial)
        missing = [index for index in self._changes.poses if index not in self._poses]
        if missing:
            raise GraphError(f"no factor places pose {list_keys(self._data.keys_at(missing))}; give an initial value")

    def _insert_motion(self, values: gtsam.Values, inertial: list[Factor]) -> None:
        """Insert the velocities and biases that new factors bring."""
        index = self._data.index
        with_bias = {index[key] for f in self._changes.of_kind("imu", "bias") for key in f.keys}
        with_velocity = {index[key] for f in self._changes.of_kind("imu", *VELOCITIES) for key in f.keys}
        for factor in inertial:
            i, j = (index[key] for key in factor.keys)
            samples = self.builder.factor(factor).preintegratedMeasurements()
            mean = (self._pose(j).translation() - self._pose(i).translation()) / samples.deltaTij()
            for k in (i, j):
                if self._velocity(k) is None:
                    self._velocities[k] = mean
        for k in sorted(with_velocity - self._with_velocity):
            values.insert(V(k), self._velocity(k))
        for k in sorted(with_bias - self._with_bias):
            values.insert(B(k), self.bias(k))
