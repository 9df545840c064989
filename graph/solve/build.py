"""A pose graph as factors and values of GTSAM; variables are ``x`` pose, ``v`` velocity, ``b`` biases, by place."""

from __future__ import annotations

from collections.abc import Callable
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
from hybridlio.graph.base.preintegration import preintegrate
from hybridlio.graph.model import coordinates as co
from hybridlio.graph.model.checks import chains_without_bias
from hybridlio.graph.model.edge_table import FORMS
from hybridlio.graph.model.graph_data import GraphData
from hybridlio.graph.model.keys import Key
from hybridlio.graph.model.measurements import Factor, Robust

FIXED_SIGMA = 1e-6  # rad, m: held as tightly as double precision solves well
_X0 = X(0)
_GRAVITY = np.array([0.0, 0.0, -GRAVITY_M_S2])
_PLANAR_SIGMAS = np.array(co.GTSAM_ORDER[2])
_PLANAR_MATRIX = np.arange(9).reshape(3, 3)[np.ix_(_PLANAR_SIGMAS, _PLANAR_SIGMAS)].ravel()
_GAUSSIAN: dict[str, Callable[[Array], gtsam.noiseModel.Base]] = {
    "sigmas": gtsam.noiseModel.Diagonal.Sigmas,
    "information": gtsam.noiseModel.Gaussian.Information,
    "covariance": gtsam.noiseModel.Gaussian.Covariance,
}


class Builder:
    """Makes GTSAM's factors of a pose graph."""

    def __init__(self, data: GraphData, bias: Callable[[int], gtsam.imuBias.ConstantBias] | None = None) -> None:
        self.data = data
        self._bias_at = bias or _given_bias(data)
        self._models: dict[tuple[str, bytes, Robust | None], gtsam.noiseModel.Base] = {}

    def graph(self, robust: bool = True) -> gtsam.NonlinearFactorGraph:
        """All factors in the order of :meth:`slots`, then those that hold fixed poses and the biases' start.

        Without the kernels where ``robust`` is False.

        Raises:
            GraphError: a fixed pose has no initial value.
        """
        graph = gtsam.NonlinearFactorGraph()
        for factor in self.edges(slice(None), robust):
            graph.add(factor)
        for other in self.data.others.values():
            graph.add(self.other(other, robust))
        for key in sorted(self.data.fixed, key=self.data.places.__getitem__):
            graph.add(self.held(key))
        for _, key, noise in chains_without_bias(self.data):
            graph.add(self.bias_start(key, noise))
        return graph

    def slots(self) -> list[int]:
        """Ids of the factors in GTSAM's order: those of the table, then the others."""
        return [*self.data.edges.ids.tolist(), *self.data.others]

    def values(self, poses: Array) -> gtsam.Values:
        """Poses at their coordinates, velocities and biases where some factor has them."""
        values = gtsam.Values()
        insert = values.insert
        for k, pose in enumerate(co.gtsam_poses(poses), _X0):
            insert(k, pose)
        for k, velocity in _velocities(self.data, poses).items():
            insert(V(k), velocity)
        for k in self.with_bias():
            insert(B(k), self._bias_at(k))
        return values

    def with_bias(self) -> list[int]:
        """Places of the poses that have biases."""
        kinds = ("imu", "bias")
        return sorted({self.data.places[k] for f in self.data.others.values() if f.kind in kinds for k in f.keys})

    def edges(self, rows: slice, robust: bool = True) -> list[Any]:
        """Between-factors of some rows of the table."""
        make = gtsam.BetweenFactorPose3 if self.data.dimension == 3 else gtsam.BetweenFactorPose2
        table = self.data.edges
        ends = (table.ends[rows] + _X0).tolist()
        models = self._edge_models(rows, robust)
        poses = co.gtsam_poses(table.measured[rows])
        return [make(i, j, T, model) for (i, j), T, model in zip(ends, poses, models, strict=True)]

    def other(self, factor: Factor, robust: bool = True) -> Any:
        """Any other factor."""
        model = None
        if factor.noise is not None:
            noise = factor.noise
            model = self._model(noise.form, noise.values.tobytes(), noise.values, factor.robust if robust else None)
        return getattr(self, f"_{factor.kind}")(factor, [self.data.places[key] for key in factor.keys], model)

    def held(self, key: Key) -> Any:
        """What holds a fixed pose at its initial value.

        Raises:
            GraphError: it has none.
        """
        at = self.data.coordinates(key)
        if at is None:
            raise GraphError(f"pose {key} is fixed but has no initial value; give one")
        model = gtsam.noiseModel.Diagonal.Sigmas(np.full(co.TANGENT_SIZE[self.data.dimension], FIXED_SIGMA))
        return self._pose_prior(self.data.places[key], at, model)

    def _edge_models(self, rows: slice, robust: bool) -> list[gtsam.noiseModel.Base]:
        """One for each row; equal noise shares one."""
        table = self.data.edges
        values = table.noise[rows]
        kernels = table.robust if robust else {}
        forms, ids = table.form[rows].tolist(), table.ids[rows].tolist()
        return [
            self._model(FORMS[form], value.tobytes(), value, kernels.get(number))
            for number, form, value in zip(ids, forms, values, strict=True)
        ]

    def _model(self, form: str, name: bytes, values: Array, kernel: Robust | None) -> gtsam.noiseModel.Base:
        known = self._models.get((form, name, kernel))
        if known is None:
            if form == "sigmas" and values.ndim == 2:
                values = np.diagonal(values)
            known = self._models[form, name, kernel] = noise_model(form, values, kernel, self.data.dimension)
        return known

    def _prior(self, factor: Factor, keys: list[int], model: Any) -> Any:
        return self._pose_prior(keys[0], factor.measured, model)

    def _pose_prior(self, place: int, at: Array, model: Any) -> Any:
        make = gtsam.PriorFactorPose3 if self.data.dimension == 3 else gtsam.PriorFactorPose2
        return make(X(place), co.gtsam_poses(at[None])[0], model)

    def _gps(self, factor: Factor, keys: list[int], model: Any) -> Any:
        z = factor.measured
        return gtsam.GPSFactorArm(X(keys[0]), z[:3], z[3:], model)

    def _attitude(self, factor: Factor, keys: list[int], model: Any) -> Any:
        z = factor.measured
        return gtsam.AttitudeFactorPose3(X(keys[0]), gtsam.Unit3(z[:3]), model, gtsam.Unit3(z[3:]))

    def _velocity(self, factor: Factor, keys: list[int], model: Any) -> Any:
        z = factor.measured
        return gtsam.PriorFactorVector(V(keys[0]), z, model)

    def _bias(self, factor: Factor, keys: list[int], model: Any) -> Any:
        z = factor.measured
        return gtsam.PriorFactorConstantBias(B(keys[0]), gtsam.imuBias.ConstantBias(z[:3], z[3:]), model)

    def _imu(self, factor: Factor, keys: list[int], _: Any) -> Any:
        assert factor.samples is not None
        z, (i, j) = factor.measured, keys
        bias, zero, stamp_ns = self._bias_at(i), np.zeros(3), int(factor.samples.stamps_ns[0])
        state = State(
            stamp_ns, np.eye(4), zero, bias.accelerometer(), bias.gyroscope(), _GRAVITY, np.eye(15), np.eye(3)
        )  # fmt: skip
        pim = preintegrate(factor.samples, state, ImuNoise(*z))
        return gtsam.CombinedImuFactor(X(i), V(i), X(j), V(j), B(i), B(j), pim)

    def bias_start(self, key: Key, noise: ImuNoise) -> Any:
        """The biases of a chain that nothing measures are around zero where it starts."""
        sigmas = np.repeat([noise.accel_bias_sigma_m_s2, noise.gyro_bias_sigma_rad_s], 3)
        model = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
        return gtsam.PriorFactorConstantBias(B(self.data.places[key]), gtsam.imuBias.ConstantBias(), model)


def noise_model(form: str, values: Array, kernel: Robust | None, dimension: int) -> gtsam.noiseModel.Base:
    """GTSAM's noise model, in the order of its tangent vectors."""
    if dimension == 2:
        values = values[_PLANAR_SIGMAS] if form == "sigmas" else values.ravel()[_PLANAR_MATRIX].reshape(3, 3)
    model = _GAUSSIAN[form](values)
    return model if kernel is None else with_kernel(model, kernel.kernel, kernel.width)


def _given_bias(data: GraphData) -> Callable[[int], gtsam.imuBias.ConstantBias]:
    """Biases as measured, else zero."""
    given = {data.places[f.keys[0]]: f.measured for f in data.others.values() if f.kind == "bias"}
    zero = np.zeros(6)

    def at(place: int) -> gtsam.imuBias.ConstantBias:
        bias = given.get(place, zero)
        return gtsam.imuBias.ConstantBias(bias[:3], bias[3:])

    return at


def _velocities(data: GraphData, poses: Array) -> dict[int, Array]:
    """First guesses: what the poses at both ends of inertial samples mean, or what was measured."""
    found: dict[int, Array] = {}
    for factor in data.others.values():
        keys = [data.places[key] for key in factor.keys]
        if factor.kind == "velocity":
            found[keys[0]] = factor.measured
        elif factor.kind == "imu" and factor.samples is not None:
            dt_s = float(factor.samples.stamps_ns[-1] - factor.samples.stamps_ns[0]) / NS_PER_S
            mean = (poses[keys[1], :3] - poses[keys[0], :3]) / dt_s
            for k in keys:
                found.setdefault(k, mean)
    return found
