"""The lidar's mounting and the IMU's clock as variables of a run's graph.

The lidar's poses and the IMU's meet in one place, the link between a scan's pose on the map path and that of the IMU
(:func:`hybridlio.graph.run.factors.map_path_factors`). A pose ``M`` on the path stands for the lidar's pose ``M·C``
with extrinsics ``C``; the IMU's pose at the scan is ``X``, its twist ``w``. If ``C`` is turned by ``φ`` and moved by
``t``, and the stamps of the samples have to move by ``δ``, then

    ``X⁻¹ M = Exp(−w·δ) · (C·Exp(φ) + t) · C⁻¹``, up to the scan's scatter.

This is linear in small changes: the links are linear factors, and each round preintegrates the samples and makes the
links anew around its start (Gauss-Newton). The variable ``c`` has the changes of the round, as far as they are
calibrated: φ in the lidar's frame, t in the IMU's, δ.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import C, M, X

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Index
from hybridlio.core.estimates import RelativePose, State
from hybridlio.core.sensors import NS_PER_S, ImuSamples
from hybridlio.graph.base import noise
from hybridlio.graph.base.marginals import Covariance
from hybridlio.graph.run.calibration_prior import SETTLED, prior_covariance
from hybridlio.record.record import Record
from hybridlio.smoothing.calibration import CalibrationPriors, Parameter, moved_extrinsics, undetermined_directions

# of a step's covariance, where its source does not tell drift and scatter apart: then all of it is drift, and a
# scatter this small keeps its matrix positive definite
_NO_SCATTER = 1e-4
_TURN, _MOVE, _CLOCK = slice(0, 3), slice(3, 6), slice(6, 7)
_BLOCKS = {"rotation": _TURN, "translation": _MOVE, "time_offset": _CLOCK}


class CalibratedLinks:
    """The calibrated links of a run, round by round.

    Args:
        record: of the run, with the stated calibration.
        priors: with ``extrinsics``, ``time_offset`` or both among their names.
    """

    def __init__(self, record: Record, priors: CalibrationPriors) -> None:
        self._record = replace(record, relative=tuple(map(_on_map_path, record.relative)))
        kept = [("extrinsics", "rotation"), ("extrinsics", "translation"), ("time_offset", "time_offset")]
        self._names = [block for name, block in kept if name in priors.names]
        sigmas = np.r_[
            np.full(3, priors.rotation_sigma_rad), np.full(3, priors.translation_sigma_m), priors.time_offset_sigma_s
        ]
        self._columns: Index = np.concatenate([np.arange(7)[_BLOCKS[name]] for name in self._names])
        self._sigmas = sigmas[self._columns]
        self._held = {name: np.empty((0, rows.stop - rows.start)) for name, rows in self._rows()}
        self.T_imu_lidar = record.calibration.T_imu_lidar
        self.offset_s = 0.0

    def applied(self) -> Record:
        """Return the record with the calibration found so far."""
        imu = self._record.imu
        moved = ImuSamples(imu.stamps_ns + round(self.offset_s * NS_PER_S), imu.gyro_rad_s, imu.accel_m_s2)
        calibration = replace(self._record.calibration, T_imu_lidar=self.T_imu_lidar)
        return replace(self._record, imu=moved, calibration=calibration)

    def link(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, states: Sequence[State]) -> None:
        """Put the calibrated links of a round in the place of the plain ones, and add the variable with its prior."""
        twists = _twists(self.applied(), states)
        for row in range(graph.size()):
            plain: Any = graph.at(row)
            keys = list(plain.keys())
            if len(keys) == 2 and keys[0] == M(k := gtsam.Symbol(keys[0]).index()) and keys[1] == X(k):
                graph.replace(row, self._link(k, values, twists[k], plain.noiseModel().R()))
        values.insert(C(0), np.zeros(len(self._columns)))
        graph.add(gtsam.PriorFactorVector(C(0), -self._changes()[self._columns], self._prior()))

    def take(self, values: gtsam.Values, covariance: Covariance) -> bool:
        """Take over a round's solution; return whether its changes are small against their uncertainty."""
        change, sigmas = np.zeros(7), np.sqrt(np.diag(covariance([C(0)])))
        change[self._columns] = values.atVector(C(0))
        self.T_imu_lidar = moved_extrinsics(self.T_imu_lidar, change[_TURN], change[_MOVE])
        self.offset_s += float(change[6])
        return bool((np.abs(change[self._columns]) <= SETTLED * sigmas).all())

    def hold(self, covariance: Covariance) -> bool:
        """Hold what the motion does not determine as stated from now on; return whether that is new."""
        before, spread = {name: len(held) for name, held in self._held.items()}, covariance([C(0)])
        for name, rows in self._rows():
            if not len(self._held[name]):
                self._held[name] = undetermined_directions(spread[rows, rows], float(self._sigmas[rows][0]))
        return any(len(held) > before[name] for name, held in self._held.items())

    def parameters(self, covariance: Covariance) -> tuple[Parameter, ...]:
        """Return ``rotation``, ``translation`` and ``time_offset``, as far as they are calibrated."""
        changes, joint, out = self._changes(), covariance([C(0)]), []
        for name, rows in self._rows():
            sigma, held = float(self._sigmas[rows][0]), self._held[name]
            spread = joint[rows, rows] + sigma**2 * held.T @ held
            out.append(Parameter(name, changes[_BLOCKS[name]], spread, sigma, held))
        return tuple(out)

    def _rows(self) -> list[tuple[str, slice]]:
        """Return the rows of each parameter among the components of ``c``."""
        ends = np.cumsum([len(np.arange(7)[_BLOCKS[name]]) for name in self._names]).tolist()
        return [(name, slice(a, b)) for name, a, b in zip(self._names, [0, *ends], ends, strict=False)]

    def _changes(self) -> Array:
        """Return what has changed since the stated calibration ``(7,)``."""
        stated = self._record.calibration.T_imu_lidar
        turned = se3.so3_log(stated[:3, :3].T @ self.T_imu_lidar[:3, :3])
        return np.concatenate([turned, self.T_imu_lidar[:3, 3] - stated[:3, 3], [self.offset_s]])

    def _prior(self) -> gtsam.noiseModel.Base:
        covariance = np.zeros((len(self._sigmas),) * 2)
        for name, rows in self._rows():
            covariance[rows, rows] = prior_covariance(float(self._sigmas[rows][0]), self._held[name])
        return noise.gaussian(covariance, "prior of the calibration")

    def _link(self, k: int, values: gtsam.Values, twist: Array, whitener: Array) -> Any:
        """Return the linear factor ``Log(X⁻¹M) − J·c`` around the values; GTSAM's linear factors are whitened."""
        T, path = values.atPose3(X(k)), values.atPose3(M(k))
        R = self.T_imu_lidar[:3, :3]
        J = np.zeros((6, 7))
        # C turned by φ is C·Exp(φ, 0); seen from the IMU that is Exp(Ad_C (φ, 0))·C, and t is in its frame already
        J[:, _TURN] = np.vstack([R, se3.hat(self.T_imu_lidar[:3, 3]) @ R])
        J[3:, _MOVE] = np.eye(3)
        J[:, 6] = -twist
        at = gtsam.Values()
        for key, pose in ((X(k), T), (M(k), path)):
            at.insert(key, pose)
        at.insert(C(0), np.zeros(len(self._columns)))
        apart = gtsam.Pose3.Logmap(T.between(path))
        make: Any = gtsam.JacobianFactor  # its stubs lack this overload
        by_calibration = -whitener @ J[:, self._columns]
        unit = gtsam.noiseModel.Unit.Create(6)
        linear = make(M(k), whitener, X(k), -whitener, C(0), by_calibration, -whitener @ apart, unit)
        return gtsam.LinearContainerFactor(linear, at)


def _on_map_path(step: RelativePose) -> RelativePose:
    """Return a step whose source has a path: without one, its errors are all drift."""
    return step if step.drift is not None else replace(step, drift=(1 - _NO_SCATTER) * step.covariance)


def _twists(record: Record, states: Sequence[State]) -> Array:
    """Return the IMU's twist ``(N, 6)`` at each scan, in its own frame."""
    stamps = np.array([state.stamp_ns for state in states])
    origin = stamps[0]
    at, known = (stamps - origin) / NS_PER_S, (record.imu.stamps_ns - origin) / NS_PER_S
    rates = np.column_stack([np.interp(at, known, record.imu.gyro_rad_s[:, axis]) for axis in range(3)])
    out = np.empty((len(states), 6))
    for k, state in enumerate(states):
        out[k, :3] = rates[k] - state.gyro_bias_rad_s
        out[k, 3:] = state.T_world_imu[:3, :3].T @ state.velocity_m_s
    return out
