"""A pose graph as factors and values of GTSAM; variables are ``x`` pose, ``v`` velocity, ``b`` biases, by place."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from hybridlio.estimates import Array, State
from hybridlio.graph import coordinates as co
from hybridlio.graph.checks import chains_without_bias
from hybridlio.graph.graph_data import GraphData
from hybridlio.graph.keys import Key
from hybridlio.graph.measurements import Factor, Noise, Robust
from hybridlio.graph.preintegration import preintegrate
from hybridlio.sensors import NS_PER_S, ImuNoise
from hybridlio.startup import GRAVITY_M_S2

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
_ROBUST = {
    "huber": gtsam.noiseModel.mEstimator.Huber,
    "cauchy": gtsam.noiseModel.mEstimator.Cauchy,
    "geman-mcclure": gtsam.noiseModel.mEstimator.GemanMcClure,
    "dcs": gtsam.noiseModel.mEstimator.DCS,
}


@dataclass(frozen=True, eq=False)
class Biases:
    """Around what each pose's inertial samples are summed up: ``(N, 6)``, accelerometer first."""

    values: Array

    def at(self, k: int) -> gtsam.imuBias.ConstantBias:
        """As GTSAM has them."""
        return gtsam.imuBias.ConstantBias(self.values[k, :3], self.values[k, 3:])


class Builder:
    """Makes GTSAM's factors of a pose graph; each factor of the pose graph has the slot of its place in the list."""

    def __init__(self, data: GraphData, biases: Array | None = None) -> None:
        self.data = data
        self.index: dict[Key, int] = {key: k for k, key in enumerate(data.keys)}
        self.biases = Biases(_given_biases(data, self.index) if biases is None else biases)
        self._models: dict[tuple[str, bytes, Robust | None], gtsam.noiseModel.Base] = {}

    def graph(self, fixed_at: Array, robust: bool = True) -> gtsam.NonlinearFactorGraph:
        """All factors in order, then those that hold fixed poses at ``fixed_at`` and biases at their start.

        Args:
            fixed_at: ``(N, 7)`` or ``(N, 3)`` coordinates of all poses.
            robust: whether kernels are in force.
        """
        graph = gtsam.NonlinearFactorGraph()
        for kind, run in groupby(self.data.factors.values(), key=lambda factor: factor.kind):
            factors = list(run)
            make, index = getattr(self, f"_{kind}"), self.index
            models = self._noise_models(factors, robust)
            for factor, measured, model in zip(factors, self._measured(factors), models, strict=True):
                graph.add(make(factor, [index[key] for key in factor.keys], measured, model))
        self._add_fixed(graph, fixed_at)
        self._add_bias_starts(graph)
        return graph

    def values(self, poses: Array) -> gtsam.Values:
        """Poses at their coordinates, velocities and biases where some factor has them."""
        values = gtsam.Values()
        for k, pose in enumerate(co.gtsam_poses(poses)):
            values.insert(_X0 + k, pose)
        for k, velocity in _velocities(self.data, self.index, poses).items():
            values.insert(V(k), velocity)
        for k in self.with_bias():
            values.insert(B(k), self.biases.at(k))
        return values

    def with_bias(self) -> list[int]:
        """Places of the poses that have biases."""
        kinds = ("imu", "bias")
        return sorted({self.index[k] for f in self.data.factors.values() if f.kind in kinds for k in f.keys})

    def _measured(self, factors: list[Factor]) -> Iterable[Any]:
        measured = [factor.measured for factor in factors]
        return co.gtsam_poses(np.array(measured)) if factors[0].kind in ("between", "prior") else measured

    def _noise_models(self, factors: list[Factor], robust: bool) -> list[gtsam.noiseModel.Base | None]:
        """One for each factor; equal noise shares one."""
        found: list[gtsam.noiseModel.Base | None] = []
        known = self._models
        for factor in factors:
            noise, kernel = factor.noise, factor.robust if robust else None
            if noise is None:
                found.append(None)
                continue
            key = (noise.form, noise.values.tobytes(), kernel)
            if key not in known:
                known[key] = noise_model(noise, kernel, self.data.dimension)
            found.append(known[key])
        return found

    def _between(self, _: Factor, keys: list[int], T: Any, model: Any) -> Any:
        make = gtsam.BetweenFactorPose3 if self.data.dimension == 3 else gtsam.BetweenFactorPose2
        return make(_X0 + keys[0], _X0 + keys[1], T, model)

    def _prior(self, _: Factor, keys: list[int], T: Any, model: Any) -> Any:
        make = gtsam.PriorFactorPose3 if self.data.dimension == 3 else gtsam.PriorFactorPose2
        return make(X(keys[0]), T, model)

    def _gps(self, _: Factor, keys: list[int], z: Array, model: Any) -> Any:
        return gtsam.GPSFactorArm(X(keys[0]), z[:3], z[3:], model)

    def _attitude(self, _: Factor, keys: list[int], z: Array, model: Any) -> Any:
        return gtsam.AttitudeFactorPose3(X(keys[0]), gtsam.Unit3(z[:3]), model, gtsam.Unit3(z[3:]))

    def _velocity(self, _: Factor, keys: list[int], z: Array, model: Any) -> Any:
        return gtsam.PriorFactorVector(V(keys[0]), z, model)

    def _bias(self, _: Factor, keys: list[int], z: Array, model: Any) -> Any:
        return gtsam.PriorFactorConstantBias(B(keys[0]), gtsam.imuBias.ConstantBias(z[:3], z[3:]), model)

    def _imu(self, factor: Factor, keys: list[int], z: Array, _: Any) -> Any:
        assert factor.samples is not None
        i, j = keys
        zero, stamp_ns = np.zeros(3), int(factor.samples.stamps_ns[0])
        accel_bias, gyro_bias = self.biases.values[i, :3], self.biases.values[i, 3:]
        state = State(stamp_ns, np.eye(4), zero, accel_bias, gyro_bias, _GRAVITY, np.eye(15), np.eye(3))
        pim = preintegrate(factor.samples, state, ImuNoise(*z))
        return gtsam.CombinedImuFactor(X(i), V(i), X(j), V(j), B(i), B(j), pim)

    def _add_fixed(self, graph: gtsam.NonlinearFactorGraph, fixed_at: Array) -> None:
        size = co.TANGENT_SIZE[self.data.dimension]
        model = gtsam.noiseModel.Diagonal.Sigmas(np.full(size, FIXED_SIGMA))
        make = gtsam.PriorFactorPose3 if self.data.dimension == 3 else gtsam.PriorFactorPose2
        for k in sorted(self.index[key] for key in self.data.fixed):
            graph.add(make(X(k), co.gtsam_poses(fixed_at[k : k + 1])[0], model))

    def _add_bias_starts(self, graph: gtsam.NonlinearFactorGraph) -> None:
        for key, noise in chains_without_bias(self.data):
            sigmas = np.repeat([noise.accel_bias_sigma_m_s2, noise.gyro_bias_sigma_rad_s], 3)
            model = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
            graph.add(gtsam.PriorFactorConstantBias(B(self.index[key]), gtsam.imuBias.ConstantBias(), model))


def noise_model(noise: Noise, kernel: Robust | None, dimension: int) -> gtsam.noiseModel.Base:
    """GTSAM's noise model, in the order of its tangent vectors."""
    values = noise.values
    if dimension == 2:
        values = values[_PLANAR_SIGMAS] if noise.form == "sigmas" else values.ravel()[_PLANAR_MATRIX].reshape(3, 3)
    model = _GAUSSIAN[noise.form](values)
    return model if kernel is None else kernel_model(kernel, model)


def kernel_model(kernel: Robust, model: gtsam.noiseModel.Base) -> gtsam.noiseModel.Base:
    """GTSAM's noise model with a robust kernel on it."""
    width = kernel.width**2 if kernel.kernel == "dcs" else kernel.width
    return gtsam.noiseModel.Robust.Create(_ROBUST[kernel.kernel](width), model)


def _given_biases(data: GraphData, index: dict[Key, int]) -> Array:
    biases = np.zeros((len(index), 6))
    for factor in data.factors.values():
        if factor.kind == "bias":
            biases[index[factor.keys[0]]] = factor.measured
    return biases


def _velocities(data: GraphData, index: dict[Key, int], poses: Array) -> dict[int, Array]:
    """First guesses: what the poses at both ends of inertial samples mean, or what was measured."""
    found: dict[int, Array] = {}
    for factor in data.factors.values():
        keys = [index[key] for key in factor.keys]
        if factor.kind == "velocity":
            found[keys[0]] = factor.measured
        elif factor.kind == "imu" and factor.samples is not None:
            dt_s = float(factor.samples.stamps_ns[-1] - factor.samples.stamps_ns[0]) / NS_PER_S
            mean = (poses[keys[1], :3] - poses[keys[0], :3]) / dt_s
            for k in keys:
                found.setdefault(k, mean)
    return found
