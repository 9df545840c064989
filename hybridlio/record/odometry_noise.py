"""How sure an odometry is that does not say it itself, from how it agrees with an IMU. No truth is needed.

An odometry that matches scans to a map has two errors: a scatter of each pose about the map, which the next step takes
back, and a drift that adds up. Over ``n`` steps the variance of its motion is ``n·drift² + 2·scatter²``, so that
differences from the IMU's motion over one and over several steps tell the two apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.pose_interpolation import PosePath
from hybridlio.core.sensors import NS_PER_S, Calibration, ImuSamples
from hybridlio.core.trajectory import Trajectory

# Lidar odometry is off by half a per cent after 100 m; that grows with the root of the way.
DRIFT_M_SQRT_M = 0.05
_DRIFT_RAD_SQRT_M = 5e-4
_SCATTER_RAD, _SCATTER_M = 1e-3, 0.02
_LEAST_WAY_M = 0.1  # at rest it drifts a little too
_HORIZON = 10  # steps
_LEAST_STEPS = 50
_WINDOW = 10  # steps
_LONGEST_GAP_S = 0.05


@dataclass(frozen=True, eq=False)
class OdometryNoise:
    """Noise of an odometry's steps.

    Attributes:
        covariances: ``(N-1, 6, 6)`` of the steps between consecutive lidar poses, rad² and m², rotation first.
        drifts: ``(N-1, 6, 6)`` what of them adds up.
        measured: what came from the IMU: ``rotation``, ``translation``, both, or nothing, where defaults stand.
    """

    covariances: Array
    drifts: Array
    measured: tuple[str, ...]


def odometry_noise(trajectory: Trajectory, imu: ImuSamples, calibration: Calibration) -> OdometryNoise:
    """Noise of a trajectory's steps from their agreement with inertial samples.

    Rotations: the gyroscope's over 1 and 10 steps; its noise is far below a lidar's, and its bias is taken out.
    Translations: the scatter of the positions about the double integral of the specific force over 10 steps, its start,
    speed and mean acceleration left free; so much shows no drift, which is taken to be 0.5 % over 100 m
    (:data:`DRIFT_M_SQRT_M`). Without samples for 50 steps, defaults stand: 1 mrad and 2 cm of scatter, and a drift of
    0.5 mrad per root metre.
    """
    T = calibration.T_imu_lidar
    poses = T @ trajectory.poses @ se3.inverse(T)
    way_m = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    way_m = np.maximum(way_m, _LEAST_WAY_M)
    scatter = np.r_[np.full(3, _SCATTER_RAD), np.full(3, _SCATTER_M)]
    drift = np.r_[np.full(3, _DRIFT_RAD_SQRT_M), np.full(3, DRIFT_M_SQRT_M)]
    measured: list[str] = []
    rotation = _rotation(trajectory.stamps_ns, poses, imu, float(np.median(way_m)))
    if rotation is not None:
        scatter[:3], drift[:3] = rotation
        measured.append("rotation")
    translation = _translation(trajectory.stamps_ns, poses, imu)
    if translation is not None:
        scatter[3:] = translation
        measured.append("translation")
    drifts = way_m[:, None] * drift**2
    T_lidar_imu = se3.inverse(T)
    turned = se3.rotate_covariance(np.array([np.diag(d) for d in drifts]), T_lidar_imu)
    return OdometryNoise(turned + se3.rotate_covariance(np.diag(2 * scatter**2), T_lidar_imu), turned, tuple(measured))


def _whole_steps(stamps_ns: NDArray[np.int64], imu: ImuSamples) -> NDArray[np.bool_]:
    """``(N-1,)`` which steps have samples all through."""
    gaps = np.flatnonzero(np.diff(imu.stamps_ns) > _LONGEST_GAP_S * NS_PER_S)
    starts, ends = imu.stamps_ns[gaps], imu.stamps_ns[gaps + 1]
    reached = (stamps_ns[:-1] >= imu.stamps_ns[0]) & (stamps_ns[1:] <= imu.stamps_ns[-1])
    # a gap lies in a step where it starts before the step's end and ends after the step's start
    touched = np.searchsorted(starts, stamps_ns[1:]) - np.searchsorted(ends, stamps_ns[:-1], side="right")
    return np.asarray(reached & (touched <= 0))


def _integral(stamps_ns: NDArray[np.int64], values: Array, at_ns: NDArray[np.int64]) -> Array:
    """The integral ``(M, 3)`` of ``(S, 3)`` values over time, from the first to ``at_ns``, straight between samples."""
    times, at = (stamps_ns - stamps_ns[0]) / NS_PER_S, (at_ns - stamps_ns[0]) / NS_PER_S
    parts = (values[1:] + values[:-1]) / 2 * np.diff(times)[:, None]
    whole = np.concatenate([np.zeros((1, 3)), np.cumsum(parts, axis=0)])
    return np.column_stack([np.interp(at, times, column) for column in whole.T])


def _rotation(stamps_ns: NDArray[np.int64], poses: Array, imu: ImuSamples, way_m: float) -> tuple[Array, Array] | None:
    """Scatter ``(3,)`` in rad and drift ``(3,)`` in rad per root metre, in the IMU's axes."""
    if len(imu) < 2:
        return None
    whole = _whole_steps(stamps_ns, imu)
    if whole.sum() < _LEAST_STEPS:
        return None
    turned = np.diff(_integral(imu.stamps_ns, imu.gyro_rad_s, stamps_ns), axis=0)
    off = turned - se3.so3_log(se3.between(poses[:-1], poses[1:])[:, :3, :3])
    off = off - np.median(off[whole], axis=0)  # the bias
    sums = np.cumsum(np.vstack([np.zeros(3), np.where(whole[:, None], off, 0.0)]), axis=0)
    runs = np.cumsum(np.r_[0, whole])
    complete = runs[_HORIZON:] - runs[:-_HORIZON] == _HORIZON
    if complete.sum() < _LEAST_STEPS:
        return None
    over_one = (off[whole] ** 2).mean(axis=0)
    over_many = ((sums[_HORIZON:] - sums[:-_HORIZON])[complete] ** 2).mean(axis=0)
    drift = np.clip((over_many - over_one) / (_HORIZON - 1), 1e-3 * over_one, over_one)
    scatter = np.sqrt(np.maximum((over_one - drift) / 2, 1e-3 * over_one))
    return scatter, np.sqrt(drift / way_m)


def _translation(stamps_ns: NDArray[np.int64], poses: Array, imu: ImuSamples) -> Array | None:
    """Scatter ``(3,)`` in m, in the IMU's axes."""
    if len(imu) < 2 or len(stamps_ns) <= _WINDOW:
        return None
    imu = imu.between(int(stamps_ns[0]), int(stamps_ns[-1]))
    if len(imu) < 2:
        return None
    at = imu.stamps_ns
    R = PosePath(stamps_ns, poses).at(at)[:, :3, :3]
    force = (R @ imu.accel_m_s2[..., None])[..., 0]
    speed = _integral(at, force, at)
    place = _integral(at, speed, stamps_ns)
    whole = np.cumsum(np.r_[0, _whole_steps(stamps_ns, imu)])
    found = []
    for k in range(0, len(stamps_ns) - _WINDOW, _WINDOW):
        if whole[k + _WINDOW] - whole[k] == _WINDOW:
            rows = slice(k, k + _WINDOW + 1)
            times = (stamps_ns[rows] - stamps_ns[k]) / NS_PER_S
            off = (poses[rows, :3, 3] - poses[k, :3, 3]) - (place[rows] - place[k])
            left = off - np.vander(times, 3) @ np.linalg.lstsq(np.vander(times, 3), off, rcond=None)[0]
            found.append(((left @ poses[k, :3, :3]) ** 2).sum(axis=0) / (_WINDOW + 1 - 3))
    if len(found) * _WINDOW < _LEAST_STEPS:
        return None
    return np.asarray(np.sqrt(np.maximum(np.mean(found, axis=0), 1e-10)))
