"""The motion of a lidar through a stretch of scans beside what an IMU measures of it, in a form that fits any mounting.

With ``M`` the matrix from the IMU's columns to the lidar's axes, and no mistake in either, ``M`` is ``R_lidar_imu``.

* Turns: ``M·(g_k - b·Δt_k) = u_k``.
* Accelerations: the second difference of the IMU's positions over ``±τ`` is the mean of its acceleration under a
  triangle, so ``Σ w_i R(t_i)·M·f_i = a_k + G``, with ``R`` the lidar's orientation, ``f`` the specific force and ``G``
  the direction up, 9.81 m/s² long. The left side is linear in ``M``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybridlio.calibration.turns import GyroPath, Turns
from hybridlio.core.arrays import Array
from hybridlio.core.pose_interpolation import PosePath
from hybridlio.core.sensors import NS_PER_S, ImuSamples
from hybridlio.core.trajectory import Trajectory

# Half the span of a second difference: the positions' 5 mm of scatter are then 0.05 m/s², a tenth of what ordinary
# driving accelerates.
_HALF_SPAN_S = 0.5
_STEP_NS = NS_PER_S // 10  # between second differences
_KEPT_SHARE = 0.9  # of squares: the largest tenth are jumps of the path and holes


@dataclass(frozen=True, eq=False)
class ComparedMotion:
    """What lidar and IMU measure of one motion.

    Attributes:
        turns: ``(N, 3)`` ``u``, of the lidar over its steps, rad.
        gyro: ``(N, 3)`` ``g``, of the gyroscope, in the IMU's columns, rad (if it measures rad/s).
        gyro_integrals: ``(N, 3)`` of its rates; the same, but not wrapped to half a turn.
        spans_s: ``(N,)`` of the steps.
        accelerations: ``(K, 3)`` ``a``, of the IMU in the frame of the path, m/s².
        forces: ``(K, 3, 3, 3)``: ``forces[k] : M`` is the mean specific force in the frame of the path.
    """

    turns: Array
    gyro: Array
    gyro_integrals: Array
    spans_s: Array
    accelerations: Array
    forces: Array

    def turn_error(self, M: Array) -> float:
        """Return the mean square of the turns' differences, rad², with the bias that fits ``M`` best."""
        errors = self.gyro @ M.T - self.turns
        return _trimmed(errors - self._mean_rate(errors) * self.spans_s[:, None])

    def _mean_rate(self, errors: Array) -> Array:
        return np.asarray(np.median(errors / self.spans_s[:, None], axis=0))

    def force_error(self, M: Array) -> float:
        """Return the mean square of the accelerations' differences, m²/s⁴, with the vertical that fits best."""
        errors = self.mean_forces(M) - self.accelerations
        return _trimmed(errors - np.median(errors, axis=0))

    def up(self, M: Array) -> Array:
        """Return ``(3,)`` the part of the specific force that is no acceleration; gravity's opposite if ``M`` fits."""
        return np.asarray(np.median(self.mean_forces(M) - self.accelerations, axis=0))

    def mean_forces(self, M: Array) -> Array:
        """Return ``(K, 3)`` the mean specific forces in the frame of the path."""
        return np.asarray(np.einsum("kijl,jl->ki", self.forces, M))


def compare_motion(paths: list[Trajectory], imu: ImuSamples, lever_m: Array) -> ComparedMotion:
    """Return what lidar and IMU measure along paths.

    Args:
        paths: of the lidar, stretches of one recording, each two poses or more.
        imu: samples on the lidar's clock; two or more.
        lever_m: ``(3,)`` the IMU in the lidar's frame.
    """
    steps, origin_ns = Turns.of(*paths), int(paths[0].stamps_ns[0])
    starts, ends = ((stamps - origin_ns) / NS_PER_S for stamps in (steps.starts_ns, steps.ends_ns))
    gyro = GyroPath(imu, origin_ns)
    whole = gyro.covers(starts, ends)
    parts = [_accelerations(path, imu, lever_m) for path in paths]
    return ComparedMotion(
        turns=steps.rotvecs[whole],
        gyro=gyro.turns(starts[whole], ends[whole]),
        gyro_integrals=gyro.integrals(starts[whole], ends[whole]),
        spans_s=steps.spans_s[whole],
        accelerations=np.concatenate([a for a, _ in parts]),
        forces=np.concatenate([f for _, f in parts]),
    )


def _accelerations(path: Trajectory, imu: ImuSamples, lever_m: Array) -> tuple[Array, Array]:
    """Return accelerations ``(K, 3)`` and forces ``(K, 3, 3, 3)`` of one stretch, each relative to its first pose."""
    half_ns = round(_HALF_SPAN_S * NS_PER_S)
    at = np.arange(path.stamps_ns[0] + half_ns, path.stamps_ns[-1] - half_ns, _STEP_NS)
    if not len(at):
        return np.empty((0, 3)), np.empty((0, 3, 3, 3))
    poses = PosePath(path.stamps_ns, path.poses)
    before, here, after = (poses.at(at + shift) @ np.r_[lever_m, 1.0] for shift in (-half_ns, 0, half_ns))
    accelerations = (after - 2 * here + before)[:, :3] / _HALF_SPAN_S**2
    R = poses.at(imu.stamps_ns)[:, :3, :3]
    products = np.einsum("sij,sl->sijl", R, imu.accel_m_s2)
    forces, whole = np.empty((len(at), 3, 3, 3)), np.zeros(len(at), bool)
    for k, stamp in enumerate(at):
        rows = slice(*np.searchsorted(imu.stamps_ns, [stamp - half_ns, stamp + half_ns]))
        weights = 1 - np.abs(imu.stamps_ns[rows] - stamp) / half_ns
        whole[k] = len(weights) > 2 and np.diff(imu.stamps_ns[rows]).max() < half_ns / 2
        forces[k] = np.tensordot(weights, products[rows], 1) / max(weights.sum(), 1e-9)
    return accelerations[whole], forces[whole]


def _trimmed(errors: Array) -> float:
    """Return the mean of squares ``(N, 3)`` without the largest."""
    squares = np.sort((errors**2).sum(axis=1))
    return float(squares[: max(1, round(_KEPT_SHARE * len(squares)))].mean())
