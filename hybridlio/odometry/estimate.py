"""The result of one step of odometry."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.estimates import RelativePose
from hybridlio.core.trajectory import Trajectory
from hybridlio.evaluation.evaluate import Steps
from hybridlio.sources.gate.gate_result import UNTESTED, GateResult


@dataclass(frozen=True, eq=False)
class InertialState:
    """What the backend estimates at a scan beside the pose.

    Attributes:
        velocity_m_s: ``(3,)`` of the IMU, in world, the lidar frame of the first scan.
        accel_bias_m_s2, gyro_bias_rad_s: ``(3,)`` each, in the IMU frame.
        sigmas: ``(9,)`` standard deviations of the three, in this order.
    """

    velocity_m_s: Array
    accel_bias_m_s2: Array
    gyro_bias_rad_s: Array
    sigmas: Array


@dataclass(frozen=True, eq=False)
class Estimate:
    """The result of one step.

    Attributes:
        index, stamp_ns: the frame's.
        pose: ``(4, 4)`` lidar pose ``T_world_lidar``; world is the lidar frame of the first scan.
        covariance: ``(6, 6)`` of a right perturbation of ``pose``, rad² and m², rotation first.
        initial: the initial relative pose ``T̂``; None at the first frame.
        relative: the relative pose ``T = δT·T̂`` that the backend was given; None at the first frame.
        step: the same step after the backend's optimisation; None at the first frame.
        seconds: time spent, by stage.
        gate: result of comparing the residual source's pose with the IMU; ``relative`` is what passed the gate.
        inertial: velocity and biases; None at the first frame and without inertial data.
    """

    index: int
    stamp_ns: int
    pose: Array
    covariance: Array
    initial: RelativePose | None
    relative: RelativePose | None
    step: RelativePose | None
    seconds: dict[str, float]
    gate: GateResult = UNTESTED
    inertial: InertialState | None = None

    def __repr__(self) -> str:
        x, y, z = self.pose[:3, 3]
        sigma_m = float(np.sqrt(self.covariance[3:, 3:].trace()))
        bridged = "" if self.relative is None or self.relative.ok else ", bridged"
        position = f"({x:.2f}, {y:.2f}, {z:.2f}) m ± {sigma_m:.2g} m"
        return f"Estimate(frame {self.index}, position {position}, {self.gate.verdict}{bridged})"

    @property
    def residual(self) -> Array:
        """``δT`` ``(4, 4)``, by which the residual source moved the initial pose; the identity at the first frame."""
        if self.initial is None or self.relative is None:
            return np.eye(4)
        return np.asarray(self.relative.pose @ se3.inverse(self.initial.pose))


def trajectory_of(estimates: Iterable[Estimate]) -> Trajectory:
    """Return the poses of some estimates, with covariances."""
    estimates = list(estimates)
    return Trajectory(
        np.array([e.stamp_ns for e in estimates]),
        np.array([e.pose for e in estimates]).reshape(-1, 4, 4),
        np.array([e.covariance for e in estimates]).reshape(-1, 6, 6),
    )


def steps_of(estimates: Iterable[Estimate]) -> Steps:
    """Return the relative poses between estimates, as the backend has them."""
    steps = [e.step for e in estimates if e.step is not None]
    return Steps(
        np.array([s.pose for s in steps]).reshape(-1, 4, 4),
        np.array([s.covariance for s in steps]).reshape(-1, 6, 6),
    )
