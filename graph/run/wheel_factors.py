"""Wheel speeds in smoothing: the way that a vehicle makes from one scan to the next, in its own axes.

The way of a step is a between-factor of GTSAM's whose rotation says nothing: its twist is the mean velocity, and the
turn of the states, over the step's time. A factor of the velocity variables would be one in Python.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Mask
from hybridlio.core.errors import DataError, EstimationError
from hybridlio.core.estimates import State
from hybridlio.core.sensors import NS_PER_S
from hybridlio.core.tables import counted
from hybridlio.graph.run.factor_groups import GroupFactors, GroupSolution, PossibleOutlier
from hybridlio.record.wheel_speeds import WheelSpeeds, read_wheel_speeds

_NO_TURN_RAD = 1.0  # of a step's rotation: a thousand times what odometry and gyroscopes say, and well conditioned
_ANY_SPEED_M_S = 100.0  # sideways and up, where nothing is said of them
_LONGEST_GAP_S = 0.5  # between speeds; within it a car's speed changes by its usual acceleration of 2 m/s², by 1 m/s


@dataclass(frozen=True, eq=False)
class WheelFit:
    """The result of using wheel speeds in smoothing.

    Attributes:
        residuals_m_s: ``(N-1, 3)`` velocity of the smoothed path less the measured one, in the axes of the IMU's frame;
            NaN for steps that are not used, and for axes that are not measured.
        weights: ``(N-1,)`` weight of each step, 0 to 1; 0 where it is not used.
    """

    residuals_m_s: Array
    weights: Array

    @property
    def rmse_m_s(self) -> float:
        """Root mean square of the forward residuals; NaN where no step is used."""
        forward = self.residuals_m_s[:, 0]
        return float(np.sqrt(np.nanmean(forward**2))) if np.isfinite(forward).any() else float("nan")

    def summary(self) -> str:
        """Return the figures on one line."""
        used = np.isfinite(self.residuals_m_s[:, 0])
        return f"{counted(int(used.sum()), 'step')} of {len(used)} with speeds, {self.rmse_m_s:.3f} m/s RMSE"


class WheelGroup:
    """Wheel speeds as a group of factors.

    Args:
        speeds: the measurements.
    """

    name = "wheels"
    robust: str | None = "huber"  # wheels slip

    def __init__(self, speeds: WheelSpeeds) -> None:
        self._speeds = speeds
        velocity = np.asarray(speeds.velocity_m_s, np.float64)
        self._is_forward = velocity.ndim == 1
        self._velocity = np.column_stack([velocity, 0 * velocity, 0 * velocity]) if self._is_forward else velocity
        self._T_imu_axle = se3.make(np.eye(3), np.zeros(3) if speeds.position_m is None else speeds.position_m)
        self._used: Mask = np.zeros(0, dtype=bool)

    def build(self, states: Sequence[State], previous: gtsam.Values | None) -> GroupFactors:
        """Return one between-factor for each step that speeds cover.

        Raises:
            EstimationError: no step has speeds.
        """
        del previous
        ways, times_s = self._ways(states)
        turns = se3.log(se3.between(*(np.array([s.T_world_imu for s in part]) for part in (states[:-1], states[1:]))))
        group = GroupFactors()
        for k in np.flatnonzero(self._used).tolist():
            step = se3.exp(np.concatenate([turns[k, :3], ways[k]]))
            group.possible_outliers.append(self._factor(k, step, times_s[k]))
        if not group.possible_outliers:
            raise EstimationError("wheel speeds: none lie in the run's time; check their clock")
        return group

    def _ways(self, states: Sequence[State]) -> tuple[Array, Array]:
        """Return the measured ways ``(N-1, 3)`` of the steps, and their times in s; note which steps have speeds."""
        stamps = np.array([state.stamp_ns for state in states])
        known_ns = np.asarray(self._speeds.stamps_ns)
        at, known = (stamps - stamps[0]) / NS_PER_S, (known_ns - stamps[0]) / NS_PER_S
        moved = np.vstack(
            [np.zeros(3), np.cumsum((self._velocity[1:] + self._velocity[:-1]) / 2 * np.diff(known)[:, None], axis=0)]
        )
        places = np.column_stack([np.interp(at, known, column) for column in moved.T])
        inside = (at[:-1] >= known[0]) & (at[1:] <= known[-1])
        gaps = np.append(np.diff(known) > _LONGEST_GAP_S, False)
        first = np.clip(np.searchsorted(known, at[:-1], side="right") - 1, 0, len(known) - 1)
        last = np.clip(np.searchsorted(known, at[1:], side="left") - 1, 0, len(known) - 1)
        sums = np.append(0, np.cumsum(gaps))
        self._used = np.asarray(inside & (sums[last + 1] - sums[first] == 0))
        return np.diff(places, axis=0), np.diff(at)

    def _factor(self, k: int, step: Array, time_s: float) -> PossibleOutlier:
        sideways = self._speeds.sideways_sigma_m_s or _ANY_SPEED_M_S
        sigma = self._speeds.sigma_m_s
        speeds = np.array([sigma, sideways, sideways]) if self._is_forward else np.full(3, sigma)
        covariance = np.diag(np.concatenate([np.full(3, _NO_TURN_RAD), speeds * time_s]) ** 2)
        T = self._T_imu_axle
        pose = gtsam.Pose3(T @ step @ se3.inverse(T))

        def make(model: gtsam.noiseModel.Base) -> gtsam.NonlinearFactor:
            return gtsam.BetweenFactorPose3(X(k), X(k + 1), pose, model)

        return PossibleOutlier(make, se3.rotate_covariance(covariance, T), f"wheel speed after scan {k}")

    def read(self, solution: GroupSolution) -> WheelFit:
        """Return how the speeds fit."""
        ways, times_s = self._ways(solution.states)
        poses = np.array([state.T_world_imu for state in solution.states]) @ self._T_imu_axle
        found = se3.log(se3.between(poses[:-1], poses[1:]))[:, 3:]
        residuals = (found - ways) / times_s[:, None]
        residuals[~self._used] = np.nan
        if self._is_forward and self._speeds.sideways_sigma_m_s is None:
            residuals[:, 1:] = np.nan
        weights = np.zeros(len(ways))
        weights[self._used] = solution.weights
        return WheelFit(residuals, weights)


def wheel_groups(speeds: WheelSpeeds | str | os.PathLike[str] | None) -> list[WheelGroup]:
    """Return the group of wheel speeds or of their file, if there are any.

    Raises:
        DataError: neither speeds nor a readable file.
    """
    if speeds is None:
        return []
    if isinstance(speeds, str | os.PathLike):
        speeds = read_wheel_speeds(Path(speeds))
    if not isinstance(speeds, WheelSpeeds):
        raise DataError(f"wheels: expected WheelSpeeds or a file, got {type(speeds).__name__}")
    return [WheelGroup(speeds)]
