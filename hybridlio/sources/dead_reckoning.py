"""The backend without a graph: each step's relative pose is put behind the last pose, and nothing is ever corrected.

For what the sources are worth by themselves, such as learned odometry without fusion. Biases are never estimated and
gravity stays as found at the start, so the IMU informs a pose only through the sources.

Covariances are compounded to first order (Barfoot, Furgale, "Associating uncertainty with three-dimensional poses for
use in estimation problems", TRO 2014, §III.B), errors of different steps taken as independent.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.estimates import RelativePose, State
from hybridlio.core.motion_limits import ACCELERATION_SIGMA_M_S2
from hybridlio.core.sensors import NS_PER_S, Calibration, Frame


class DeadReckoning:
    """Chains relative poses.

    Of a step with ``drift`` only that adds up along the path; its scatter belongs to the scan, whose pose it makes less
    sure until the next step takes it back. Poses relative to other scans than the last (``keyframes``) would need a
    graph, and are not used. Steps that share an error, as preintegrated ones share that of an unknown speed, drift by
    more than the covariance says.
    """

    name = "none"

    def __init__(self, calibration: Calibration) -> None:
        self._T_imu_lidar = calibration.T_imu_lidar

    def start(self, state: State) -> None:
        """Take the first scan's state as it is."""
        self._state = state
        self._path = state.covariance[:6, :6]
        self._step: RelativePose | None = None

    def update(self, frame: Frame, relative: RelativePose) -> State:
        """The state at ``frame``: the last pose and the step, at the step's mean velocity."""
        before, stamp_ns = self._state, frame.scan.stamp_ns
        dt_s = (stamp_ns - before.stamp_ns) / NS_PER_S
        step = self._T_imu_lidar @ relative.pose @ se3.inverse(self._T_imu_lidar)
        T_world_imu = se3.orthonormalise(before.T_world_imu @ step)
        velocity = (T_world_imu[:3, 3] - before.T_world_imu[:3, 3]) / dt_s
        covariance = before.covariance.copy()
        covariance[:9] = covariance[:, :9] = 0.0  # what is left, of the biases, nothing has informed
        covariance[:9, :9] = self._compounded(relative, step, T_world_imu[:3, :3], dt_s)
        self._step = relative
        self._state = replace(
            before, stamp_ns=stamp_ns, T_world_imu=T_world_imu, velocity_m_s=velocity, covariance=covariance
        )
        return self._state

    def last_step(self) -> RelativePose:
        """The relative pose that the last update was given."""
        assert self._step is not None, "there is no step before the first update"
        return replace(self._step, source=self.name, drift=None, earlier_scans=())

    def _compounded(self, relative: RelativePose, step: Array, R_world_imu: Array, dt_s: float) -> Array:
        """``(9, 9)`` of rotation, position and velocity after the step; moves the path's covariance on.

        The mean velocity is the step's translation turned by the last pose, so that an error of heading is in both and
        a prediction from the two does not suffer from it.
        """
        along, beside, before = (se3.rotate_covariance(part, self._T_imu_lidar) for part in _parts(relative))
        path = self._state.covariance[:6, :6] if relative.drift is None else self._path
        self._path = se3.compose_covariance(path, step, along)
        by_path, by_step = np.zeros((9, 6)), np.zeros((9, 6))
        by_path[:6], by_step[:6] = se3.adjoint(se3.inverse(step)), np.eye(6)
        by_path[6:, :3] = -R_world_imu @ step[:3, :3].T @ se3.hat(step[:3, 3]) / dt_s
        by_step[6:, 3:] = R_world_imu / dt_s
        total = by_path @ path @ by_path.T + by_step @ (along + beside) @ by_step.T
        total[6:, 6:] += by_step[6:] @ before @ by_step[6:].T + np.eye(3) * (ACCELERATION_SIGMA_M_S2 * dt_s / 2) ** 2
        return np.asarray((total + total.T) / 2)


def _parts(relative: RelativePose) -> tuple[Array, Array, Array]:
    """Of a step's covariance what adds up, and the scatter of its later and of its earlier scan, ``(6, 6)`` each.

    A step that failed says nothing of its scan, all of whose covariance lies beside the path that the source goes on.
    """
    nothing = np.zeros((6, 6))
    if relative.drift is None:
        return relative.covariance, nothing, nothing
    if not relative.ok:
        return relative.drift, relative.covariance, nothing
    scatter = (relative.covariance - relative.drift) / 2
    return relative.drift, scatter, scatter
