"""The backend without a graph: dead reckoning, which composes relative poses and never corrects them.

It shows what sources achieve by themselves, such as learned odometry without fusion. Biases are not estimated and
gravity stays as it was at the start, so the IMU acts on a pose only through the sources.

Covariances are compounded to first order (Barfoot, Furgale, "Associating uncertainty with three-dimensional poses for
use in estimation problems", TRO 2014, §III.B). Errors of different steps are taken as independent.
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
    """Composes relative poses.

    Of a step with ``drift``, only the drift adds up along the path. The rest of its covariance belongs to the scan
    whose pose it blurs, and the next step removes it. Poses relative to earlier scans (``earlier_scans``) need a graph
    and are ignored. Steps with a common error, such as preintegrated ones from an unknown speed, drift by more than
    the covariance says.

    Args:
        calibration: the extrinsics.
    """

    name = "none"

    def __init__(self, calibration: Calibration) -> None:
        self._T_imu_lidar = calibration.T_imu_lidar
        self._state: State | None = None
        self._path_covariance = np.zeros((6, 6))  # of the last pose without its own scan's scatter
        self._step: RelativePose | None = None

    def start(self, state: State) -> None:
        """Start at the first scan's state."""
        self._state = state
        self._path_covariance = state.covariance[:6, :6]
        self._step = None

    def update(self, frame: Frame, relative: RelativePose) -> State:
        """Return the state at ``frame``: the last pose composed with the step, moving at the step's mean velocity."""
        before, stamp_ns = self._state, frame.scan.stamp_ns
        assert before is not None, "call start first"
        dt_s = (stamp_ns - before.stamp_ns) / NS_PER_S
        step = self._T_imu_lidar @ relative.pose @ se3.inverse(self._T_imu_lidar)
        T_world_imu = se3.orthonormalise(before.T_world_imu @ step)
        velocity = (T_world_imu[:3, 3] - before.T_world_imu[:3, 3]) / dt_s
        covariance = before.covariance.copy()
        covariance[:9] = covariance[:, :9] = 0.0  # the biases' part stays as it was at the start
        covariance[:9, :9] = self._compound(before, relative, step, T_world_imu[:3, :3], dt_s)
        self._step = relative
        self._state = replace(
            before, stamp_ns=stamp_ns, T_world_imu=T_world_imu, velocity_m_s=velocity, covariance=covariance
        )
        return self._state

    def last_step(self) -> RelativePose:
        """Return the relative pose that the last update was given."""
        assert self._step is not None, "call update first"
        return replace(self._step, source=self.name, drift=None, earlier_scans=())

    def _compound(self, before: State, relative: RelativePose, step: Array, R_world_imu: Array, dt_s: float) -> Array:
        """Return the covariance ``(9, 9)`` of rotation, position and velocity after the step; update the path's.

        The mean velocity is the step's translation rotated by the last pose. An error in heading is therefore in both
        position and velocity, and cancels in a prediction from the two.
        """
        drift, later, earlier = (se3.rotate_covariance(part, self._T_imu_lidar) for part in _parts(relative))
        path = before.covariance[:6, :6] if relative.drift is None else self._path_covariance
        self._path_covariance = se3.compose_covariance(path, step, drift)
        by_path, by_step = np.zeros((9, 6)), np.zeros((9, 6))  # Jacobians
        by_path[:6], by_step[:6] = se3.adjoint(se3.inverse(step)), np.eye(6)
        by_path[6:, :3] = -R_world_imu @ step[:3, :3].T @ se3.hat(step[:3, 3]) / dt_s
        by_step[6:, 3:] = R_world_imu / dt_s
        total = by_path @ path @ by_path.T + by_step @ (drift + later) @ by_step.T
        # the velocity at the scan differs from the step's mean by half the step times the acceleration
        total[6:, 6:] += by_step[6:] @ earlier @ by_step[6:].T + np.eye(3) * (ACCELERATION_SIGMA_M_S2 * dt_s / 2) ** 2
        return np.asarray((total + total.T) / 2)


def _parts(relative: RelativePose) -> tuple[Array, Array, Array]:
    """Split a step's covariance into drift, scatter of the later scan and scatter of the earlier one, ``(6, 6)`` each.

    A failed step does not measure its scan: all of its covariance is scatter beside the path of the source, which
    continues from the scan before.
    """
    nothing = np.zeros((6, 6))
    if relative.drift is None:
        return relative.covariance, nothing, nothing
    if not relative.ok:
        return relative.drift, relative.covariance, nothing
    scatter = (relative.covariance - relative.drift) / 2
    return relative.drift, scatter, scatter
