"""A pose graph as GTSAM's factors and values.

Variables are ``x`` pose, ``v`` velocity and ``b`` biases, by pose index, ``l`` landmark, by landmark index, and ``c``
calibration, by its order in the graph.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from hybridlio.core.arrays import Array
from hybridlio.core.errors import GraphError
from hybridlio.core.estimates import State
from hybridlio.core.motion_limits import GRAVITY_M_S2
from hybridlio.core.sensors import NS_PER_S, ImuNoise
from hybridlio.graph.base.noise import with_kernel
from hybridlio.graph.base.preintegration import preintegrate, preintegrate_constant_biases
from hybridlio.graph.calibration.biases import BiasAt, bias_variable, measured_biases, turn_rates
from hybridlio.graph.calibration.factors import (
    AntennaFix,
    SensorStep,
    extrinsics_matrix,
    inertial_factor,
)
from hybridlio.graph.calibration.moving_pose import MovingPose
from hybridlio.graph.calibration.variables import insert_calibrations, prior, variable_of
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.calibrations import CalibrationKind, of_kind
from hybridlio.graph.model.connectivity import InertialChain, chains_without_bias, walks
from hybridlio.graph.model.edge_table import FORMS
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.model.keys import Key
from hybridlio.graph.model.marginals import Marginal
from hybridlio.graph.model.measurements import IN_OWN_ORDER, OF_LANDMARKS, Factor
from hybridlio.graph.model.noise import Robust
from hybridlio.graph.model.user_residual import altitude, heading
from hybridlio.graph.solve.custom_factors import body_velocity_factor, custom_factor, linear_factor
from hybridlio.graph.solve.landmark_factors import initial_landmarks, insert_landmarks, observation

# rad, m: of the prior that holds a fixed pose. Small against any sensor, large enough that information of 1e12 beside
# that of edges still solves in double precision.
FIXED_SIGMA = 1e-6
_X0 = X(0)
_GRAVITY = np.array([0.0, 0.0, -GRAVITY_M_S2])
_PLANAR_ORDER = np.array(co.GTSAM_ORDER[2])
_GAUSSIAN: dict[str, Callable[[Array], gtsam.noiseModel.Base]] = {
    "sigmas": gtsam.noiseModel.Diagonal.Sigmas,
    "information": gtsam.noiseModel.Gaussian.Information,
    "covariance": gtsam.noiseModel.Gaussian.Covariance,
}


class Builder:
    """Makes GTSAM's factors and values of a pose graph.

    Args:
        data: the graph.
        bias_at: biases around which the samples of an IMU factor are preintegrated, by the variable of its first
            biases; by default those of bias factors and stated constant ones, else zero.
        pose_variable: of a pose, by index, in factors in Python, which GTSAM cannot rename.
    """

    def __init__(
        self, data: GraphData, bias_at: BiasAt | None = None, pose_variable: Callable[[int], int] = X
    ) -> None:  # fmt: skip
        self.data, self._pose_variable = data, pose_variable
        self._bias_at = bias_at or measured_biases(data)
        self._models: dict[tuple[int, bytes, Robust | None], gtsam.noiseModel.Base] = {}

    def graph(self, robust: bool = True) -> gtsam.NonlinearFactorGraph:
        """Return all factors in the order of :meth:`factor_ids`, then the priors of fixed poses, biases, calibration.

        Args:
            robust: whether to apply the robust kernels.

        Raises:
            GraphError: a fixed pose has no initial value.
        """
        graph = gtsam.NonlinearFactorGraph()
        for edge in self.edges(slice(None), robust):
            graph.add(edge)
        for factor in self.data.other_factors.values():
            graph.add(self.factor(factor, robust))
        for key in sorted(self.data.fixed, key=self.data.index.__getitem__):
            graph.add(self.fixed_pose_prior(key))
        for chain in chains_without_bias(self.data):
            graph.add(self.initial_bias_prior(chain))
        for name in self.data.calibrations:
            graph.add(prior(self.data.calibrations, name))
        return graph

    def factor_ids(self) -> list[int]:
        """Return the factors' ids in the order of :meth:`graph`: edges, then the others."""
        return [*self.data.edges.ids.tolist(), *self.data.other_factors]

    def values(self, poses: Array) -> gtsam.Values:
        """Return initial values: poses at their coordinates, and what factors concern beside them."""
        values = gtsam.Values()
        insert = values.insert_or_assign  # takes poses in half the time of insert, which tries vectors first
        for k, pose in enumerate(co.gtsam_poses(poses), _X0):
            insert(k, pose)
        for k, velocity in _initial_velocities(self.data, poses).items():
            insert(V(k), velocity)
        for k in self.poses_with_bias():
            insert(B(k), self._bias_at(B(k)))
        insert_landmarks(values, initial_landmarks(self.data, poses))
        insert_calibrations(values, self.data.calibrations)
        return values

    def poses_with_bias(self) -> list[int]:
        """Return the indices of the poses whose biases are variables."""
        walking = (f for f in self.data.other_factors.values() if f.kind == "bias" or walks(self.data, f))
        return sorted({self.data.index[key] for factor in walking for key in factor.keys})

    @property
    def has_inertial_factors(self) -> bool:
        """Whether samples are preintegrated around biases."""
        return any(factor.kind == "imu" for factor in self.data.other_factors.values())

    def edges(self, rows: slice, robust: bool = True) -> list[Any]:
        """Return the between-factors of some rows of the edge table."""
        make = gtsam.BetweenFactorPose3 if self.data.dimension == 3 else gtsam.BetweenFactorPose2
        table = self.data.edges
        ends = (table.ends[rows] + _X0).tolist()
        models = self._edge_models(rows, robust)
        poses = co.gtsam_poses(table.measured[rows])
        return [make(i, j, T, model) for (i, j), T, model in zip(ends, poses, models, strict=True)]

    def factor(self, factor: Factor, robust: bool = True) -> Any:
        """Return any factor but a between-factor."""
        if factor.kind in OF_LANDMARKS:
            return observation(self.data, factor, robust)
        if factor.kind == "gtsam":
            return factor.code.rekey([X(self.data.index[key]) for key in factor.keys])
        model = None
        if factor.noise is not None:
            noise = factor.noise
            kernel = factor.robust if robust else None
            own_order = factor.kind in IN_OWN_ORDER
            model = noise_model(noise.form, noise.values, kernel, 3 if own_order else self.data.dimension)
        return getattr(self, f"_{factor.kind.replace('-', '_')}")(
            factor, [self.data.index[key] for key in factor.keys], model
        )

    def fixed_pose_prior(self, key: Key) -> Any:
        """Return the prior that holds a fixed pose at its initial value.

        Raises:
            GraphError: the pose has no initial value.
        """
        at = self.data.initial_value(key)
        if at is None:
            raise GraphError(f"pose {key} is fixed but has no initial value; give one by set_initial")
        model = gtsam.noiseModel.Diagonal.Sigmas(np.full(self.data.tangent_size, FIXED_SIGMA))
        return self._pose_prior(self.data.index[key], at, model)

    def initial_bias_prior(self, chain: InertialChain) -> Any:
        """Return the prior of zero biases at the start of a chain without a bias factor, as wide as its noise says."""
        sigmas = np.repeat([chain.noise.accel_bias_sigma_m_s2, chain.noise.gyro_bias_sigma_rad_s], 3)
        model = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
        variable = B(self.data.index[chain.start])
        return gtsam.PriorFactorConstantBias(variable, gtsam.imuBias.ConstantBias(), model)

    def _edge_models(self, rows: slice, robust: bool) -> list[gtsam.noiseModel.Base]:
        """Return one noise model per row; rows of equal noise share one."""
        table, models = self.data.edges, self._models
        values = _in_gtsams_order(table.noise_values[rows], self.data.dimension)
        kernels = table.robust if robust else {}
        forms, ids = table.form[rows].tolist(), table.ids[rows].tolist()
        found = []
        for factor_id, form, value, text in zip(ids, forms, values, table.noise_bytes(rows), strict=True):
            name = form, text, kernels.get(factor_id)
            if (model := models.get(name)) is None:
                own = np.diagonal(value) if FORMS[form] == "sigmas" else value
                model = models[name] = _model(FORMS[form], own, kernels.get(factor_id))
            found.append(model)
        return found

    def _prior(self, factor: Factor, indices: list[int], model: Any) -> Any:
        return self._pose_prior(indices[0], factor.measured, model)

    def _pose_prior(self, index: int, at: Array, model: Any) -> Any:
        make = gtsam.PriorFactorPose3 if self.data.dimension == 3 else gtsam.PriorFactorPose2
        return make(X(index), co.gtsam_poses(at[None])[0], model)

    def _gps(self, factor: Factor, indices: list[int], model: Any) -> Any:
        z, arm = factor.measured, self._calibrated(factor, "lever_arm")
        return AntennaFix(z[:3], self._moving(factor, indices[0]), z[3:], arm).factor(model)

    def _sensor_step(self, factor: Factor, indices: list[int], model: Any) -> Any:
        first, second = (self._moving(factor, index) for index in indices)
        stated = extrinsics_matrix(of_kind(self.data.calibrations, factor.calibration, "extrinsics"))
        variables = (self._calibrated(factor, "extrinsics"), self._calibrated(factor, "scale"))
        return SensorStep(co.to_matrices(factor.measured[None])[0], first, second, stated, *variables).factor(model)

    def _moving(self, factor: Factor, index: int) -> MovingPose:
        """Return a pose of a factor at the time that the factor's clock gives it."""
        planar, clock = self.data.dimension == 2, self._calibrated(factor, "time_offset")
        if clock is None:
            return MovingPose(self._pose_variable(index), planar)
        return MovingPose(self._pose_variable(index), planar, (clock, V(index)), self._rates.get(index))

    def _calibrated(self, factor: Factor, kind: CalibrationKind) -> int | None:
        """Return GTSAM's variable of the calibration of one kind that a factor depends on, or None."""
        found = of_kind(self.data.calibrations, factor.calibration, kind)
        return None if found is None else variable_of(self.data.calibrations, found.name)

    @cached_property
    def _rates(self) -> dict[int, Array]:
        return turn_rates(self.data, self._bias_at)

    def _attitude(self, factor: Factor, indices: list[int], model: Any) -> Any:
        z = factor.measured
        return gtsam.AttitudeFactorPose3(X(indices[0]), gtsam.Unit3(z[:3]), model, gtsam.Unit3(z[3:]))

    def _marginal(self, factor: Factor, indices: list[int], _: Any) -> Any:
        found = Marginal.unpacked(factor.measured, len(indices), self.data.dimension, factor.label)
        return linear_factor(found, [self._pose_variable(index) for index in indices])

    def _velocity(self, factor: Factor, indices: list[int], model: Any) -> Any:
        return gtsam.PriorFactorVector(V(indices[0]), factor.measured, model)

    def _custom(self, factor: Factor, indices: list[int], model: Any) -> Any:
        return custom_factor(factor.code, [self._pose_variable(k) for k in indices], model)

    def _altitude(self, factor: Factor, indices: list[int], model: Any) -> Any:
        return custom_factor(
            altitude(float(factor.measured[0]), factor.label), [self._pose_variable(indices[0])], model
        )

    def _heading(self, factor: Factor, indices: list[int], model: Any) -> Any:
        residual = heading(float(factor.measured[0]), factor.label, self.data.dimension)
        return custom_factor(residual, [self._pose_variable(indices[0])], model)

    def _body_velocity(self, factor: Factor, indices: list[int], model: Any) -> Any:
        return body_velocity_factor(factor.measured, self._pose_variable(indices[0]), V(indices[0]), model)

    def _bias(self, factor: Factor, indices: list[int], model: Any) -> Any:
        z = factor.measured
        return gtsam.PriorFactorConstantBias(B(indices[0]), gtsam.imuBias.ConstantBias(z[:3], z[3:]), model)

    def _imu(self, factor: Factor, indices: list[int], _: Any) -> Any:
        assert factor.samples is not None
        z, (i, j) = factor.measured, indices
        bias = self._bias_at(bias_variable(self.data, factor))
        zero, stamp_ns = np.zeros(3), int(factor.samples.stamps_ns[0])
        # preintegration only uses the state's stamp, biases and gravity
        state = State(
            stamp_ns, np.eye(4), zero, bias.accelerometer(), bias.gyroscope(), _GRAVITY, np.eye(15), np.eye(3)
        )  # fmt: skip
        constant = self._calibrated(factor, "bias")
        integrate = preintegrate if constant is None else preintegrate_constant_biases
        pim = integrate(factor.samples, state, ImuNoise(*z))
        biases = (B(i), B(j)) if constant is None else (constant,)
        return inertial_factor((X(i), V(i), X(j), V(j)), biases, self._calibrated(factor, "gravity"), pim)


def noise_model(form: str, values: Array, kernel: Robust | None, dimension: int) -> gtsam.noiseModel.Base:
    """Return GTSAM's noise model, in the order of GTSAM's tangent vectors."""
    return _model(form, _in_gtsams_order(values[None], dimension)[0], kernel)


def _in_gtsams_order(values: Array, dimension: int) -> Array:
    """Return sigmas ``(M, d)`` or matrices ``(M, d, d)`` in the order of GTSAM's tangent vectors."""
    if dimension == 3:
        return values
    return values[:, _PLANAR_ORDER] if values.ndim == 2 else values[:, _PLANAR_ORDER][:, :, _PLANAR_ORDER]


def _model(form: str, values: Array, kernel: Robust | None) -> gtsam.noiseModel.Base:
    model = _GAUSSIAN[form](values)
    return model if kernel is None else with_kernel(model, kernel.kernel, kernel.width)


def _initial_velocities(data: GraphData, poses: Array) -> dict[int, Array]:
    """Return initial velocities by pose index: from velocity factors, else the mean between an IMU factor's poses."""
    found: dict[int, Array] = {}
    for factor in data.other_factors.values():
        indices = [data.index[key] for key in factor.keys]
        if factor.kind == "velocity":
            found[indices[0]] = factor.measured
        elif factor.kind == "body-velocity":
            found[indices[0]] = co.to_matrices(poses[indices[0]][None])[0, :3, :3] @ factor.measured
        elif factor.kind == "imu" and factor.samples is not None:
            dt_s = float(factor.samples.stamps_ns[-1] - factor.samples.stamps_ns[0]) / NS_PER_S
            mean = (poses[indices[1], :3] - poses[indices[0], :3]) / dt_s
            for k in indices:
                found.setdefault(k, mean)
    return found
