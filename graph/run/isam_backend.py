"""The online factor graph: poses, velocities, biases and gravity in iSAM2 (Kaess et al., IJRR 2012)."""

from __future__ import annotations

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, G, V, X

from hybridlio.core import se3
from hybridlio.core.errors import GraphError
from hybridlio.core.estimates import RelativePose, State
from hybridlio.core.sensors import NS_PER_S, Frame
from hybridlio.graph.base.isam import gtsam_message, incremental_solver, relinearising_solver
from hybridlio.graph.base.marginals import step_covariance
from hybridlio.graph.base.preintegration import gtsam_bias, navigation_of
from hybridlio.graph.run import factors
from hybridlio.graph.run.inertial_steps import InertialSteps
from hybridlio.graph.run.scan_numbers import ScanNumbers

# While tilt, speed and biases converge (2 s at 10 Hz), every step relinearises everything that it changes; the graph is
# still small. In the very first steps the speed may be wrong by 20 m/s and gravity's direction by 0.3 rad, too much for
# that: they are solved from scratch by damped iterations.
WARM_UP_STEPS = 20
_DAMPED_STEPS = 5


class IncrementalBackend:
    """A graph of every scan's pose; consecutive scans are joined by IMU samples and the front end's relative pose.

    Args:
        steps: preintegrates the samples between scans.
    """

    name = "incremental"
    _removes_factors = False

    def __init__(self, steps: InertialSteps) -> None:
        self._steps = steps
        self._T_imu_lidar = steps.T_imu_lidar
        self._T_lidar_imu = se3.inverse(steps.T_imu_lidar)
        self._k = 0
        self._scans = ScanNumbers(0)
        self._newest: State | None = None
        self._graph, self._values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._isam = incremental_solver(self._removes_factors)

    @property
    def _state(self) -> State:
        """The newest scan's state."""
        assert self._newest is not None, "call start first"
        return self._newest

    def start(self, state: State) -> None:
        """Put the first scan's pose at the origin, the other variables at ``state`` with its covariance."""
        self._k = 0
        self._scans = ScanNumbers(state.stamp_ns)
        self._newest = state
        self._graph, self._values = factors.start_factors(state)
        self._isam = incremental_solver(self._removes_factors)
        self._isam.update(self._graph, self._values)

    def update(self, frame: Frame, relative: RelativePose) -> State:
        """Add the step to ``frame`` and return the state there.

        Raises:
            GraphError: the graph cannot be solved; the message names the variable.
            DataError: a pose relative to an earlier scan gives a stamp that no scan has.
        """
        state, stamp_ns = self._state, frame.scan.stamp_ns
        pim = self._steps.preintegrated(frame, state)
        graph = factors.step_factors(self._k, state, relative, pim, stamp_ns, self._T_imu_lidar, self._scans)
        values, initial = gtsam.Values(), self._initial_state(frame, relative, pim)
        factors.insert_step(values, self._k, state, initial, relative, self._scans)
        try:
            self._solve(graph, values, self._order(relative, values))
        except RuntimeError as error:
            raise GraphError(f"frame {frame.index}: the graph cannot be solved: {gtsam_message(error)}") from error
        self._k += 1
        self._scans.add(stamp_ns, on_map_path=relative.drift is not None)
        self._newest = self._read(stamp_ns)
        return self._newest

    def last_step(self) -> RelativePose:
        """Return the step to the current scan, lidar frames, with its covariance from all factors together."""
        i, j = X(self._k - 1), X(self._k)
        T_w_i, T_w_j = (self._isam.calculateEstimatePose3(key).matrix() for key in (i, j))
        joint = self._isam.jointMarginalCovariance([i, j]).fullMatrix()
        step = se3.between(T_w_i, T_w_j)
        covariance = se3.rotate_covariance(step_covariance(joint, step), self._T_lidar_imu)
        pose = self._T_lidar_imu @ step @ self._T_imu_lidar
        return RelativePose(pose, (covariance + covariance.T) / 2, source=self.name, from_imu=self._state.has_imu)

    def _initial_state(
        self, frame: Frame, relative: RelativePose, pim: gtsam.PreintegratedCombinedMeasurements | None
    ) -> State:
        """Initial values of the new variables: from the relative pose, or from the IMU where that failed."""
        state, stamp_ns = self._state, frame.scan.stamp_ns
        if pim is not None and not relative.ok:
            then = pim.predict(navigation_of(state), gtsam_bias(state))
            T_world_imu, velocity = then.pose().matrix(), then.velocity()
        else:
            T_world_imu = state.T_world_imu @ self._T_imu_lidar @ relative.pose @ self._T_lidar_imu
            dt_s = (stamp_ns - state.stamp_ns) / NS_PER_S
            velocity = (T_world_imu[:3, 3] - state.T_world_imu[:3, 3]) / dt_s
        return State(
            stamp_ns, T_world_imu, velocity, state.accel_bias_m_s2, state.gyro_bias_rad_s, state.gravity_m_s2,
            state.covariance, state.gravity_covariance, state.has_imu,
        )  # fmt: skip

    def _solve(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, order: gtsam.KeyGroupMap | None) -> None:
        if self._k >= WARM_UP_STEPS:
            self._isam.update(graph, values, [], order)
            return
        self._graph.push_back(graph)
        if self._k < _DAMPED_STEPS:
            self._values.insert(values)
            params = gtsam.LevenbergMarquardtParams()
            params.setLinearSolverType("MULTIFRONTAL_QR")
            self._values = gtsam.LevenbergMarquardtOptimizer(self._graph, self._values, params).optimize()
            self._isam = relinearising_solver()
            self._isam.update(self._graph, self._values)
            return
        self._isam.update(graph, values)
        if self._k == WARM_UP_STEPS - 1:  # continue in the solver that keeps old linearisation points
            self._values = self._isam.calculateEstimate()
            self._isam = incremental_solver(self._removes_factors)
            self._isam.update(self._graph, self._values)

    def _order(self, relative: RelativePose, new: gtsam.Values) -> gtsam.KeyGroupMap | None:
        """Constrain iSAM2 to eliminate scan by scan, from the oldest scan that a step reaches back to.

        By default iSAM2 eliminates the variables of new factors last, including those of old scans. Within a hundred
        scans each update would then affect a large part of the graph and take fifty times as long.

        Returns:
            The constraint, or None for a step that reaches back to the last scan only.
        """
        found = [j for k in relative.earlier_scans if (j := self._scans.number(k.stamp_ns)) is not None]
        if not found or min(found) >= self._k:
            return None
        order = gtsam.KeyGroupMap()
        for place, k in enumerate(range(min(found), self._k + 2)):
            for key in (variable(k) for variable in factors.VARIABLES):
                if self._isam.valueExists(key) or new.exists(key):
                    order.insert2(key, place)
        return order

    def _read(self, stamp_ns: int) -> State:
        """Return the newest scan's state with its marginal covariances."""
        k, isam = self._k, self._isam
        pose = isam.calculateEstimatePose3(X(k)).matrix()
        if not self._state.has_imu:
            covariance = np.eye(15)
            covariance[:6, :6] = isam.marginalCovariance(X(k))
            zero = np.zeros(3)
            return State(stamp_ns, pose, zero, zero, zero, self._state.gravity_m_s2, covariance, np.eye(3), False)
        bias = isam.calculateEstimateConstantBias(B(k))
        covariance = isam.jointMarginalCovariance([X(k), V(k), B(k)]).fullMatrix()
        return State(
            stamp_ns, pose, isam.calculateEstimateVector(V(k)), bias.accelerometer(), bias.gyroscope(),
            isam.calculateEstimateVector(G(k)), (covariance + covariance.T) / 2, isam.marginalCovariance(G(k)),
        )  # fmt: skip
