"""Estimate the noise of an odometry from its differences to an IMU, without ground truth.

An odometry that registers scans to a map has two errors: a scatter of each pose about the map, which the next step
undoes, and a drift that accumulates. Over ``n`` steps the variance of its motion is ``n·drift² + 2·scatter²``.
Differences from the IMU's motion over one step and over several steps therefore separate the two.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Mask, Stamps
from hybridlio.core.pose_interpolation import PosePath
from hybridlio.core.sensors import NS_PER_S, Calibration, ImuSamples
from hybridlio.core.trajectory import Trajectory

# Drift is a random walk: it grows with the square root of the distance. 0.05 m per root metre is 0.5 % after 100 m,
# typical of lidar odometry on KITTI; 0.5 mrad per root metre is 0.3° after 100 m.
DRIFT_M_SQRT_M = 0.05
_DRIFT_RAD_SQRT_M = 5e-4
# Scatter without an IMU: a lidar's range noise, and the angle at which that noise is seen 20 m away.
_SCATTER_RAD, _SCATTER_M = 1e-3, 0.02
_MIN_STEP_LENGTH_M = 0.1  # a standing vehicle drifts too: as one that moves at 1 m/s with 10 scans a second
# Steps over which drift is compared with scatter: drift then counts ten times, and the gyroscope's own error over a
# second is still well below a lidar's.
_HORIZON_STEPS = 10
# Steps per window of the double integral: a second, over which an accelerometer bias that varies is still constant.
_WINDOW_STEPS = 10
_MIN_STEPS = 50  # a standard deviation from 50 samples is known to 10 %
_LONGEST_GAP_S = 0.05  # over half a step of a 10 Hz lidar without a sample, the IMU's motion is no reference
_MIN_VARIANCE_SHARE = 1e-3  # floor of drift's and scatter's variance, relative to that of a step: keeps both positive
_MIN_VARIANCE_M2 = 1e-10  # floor of the translation's scatter, (10 µm)²: keeps the covariance positive definite


@dataclass(frozen=True, eq=False)
class OdometryNoise:
    """Noise of an odometry's steps.

    Attributes:
        covariances: ``(N-1, 6, 6)`` of the steps between consecutive lidar poses, rad² and m², rotation first.
        drifts: ``(N-1, 6, 6)`` the part of ``covariances`` that accumulates over steps.
        measured: which parts come from the IMU: ``rotation``, ``translation``, both or neither. The others are
            defaults.
    """

    covariances: Array
    drifts: Array
    measured: tuple[str, ...]


def odometry_noise(trajectory: Trajectory, imu: ImuSamples, calibration: Calibration) -> OdometryNoise:
    """Estimate the noise of a trajectory's steps from their differences to IMU samples.

    Rotation: compared with the gyroscope's over 1 and 10 steps. The gyroscope's noise is far below a lidar's; its bias
    is subtracted. Translation: the scatter of the positions about the double integral of the specific force over 10
    steps, with free start, velocity and mean acceleration. This does not show drift, which is assumed to be 0.5 %
    after 100 m (:data:`DRIFT_M_SQRT_M`). With samples for fewer than 50 steps defaults apply: 1 mrad and 2 cm of
    scatter, and a drift of 0.5 mrad per root metre.

    Args:
        trajectory: lidar poses.
        imu: samples on the same clock; may be empty.
        calibration: ``T_imu_lidar``.
    """
    T = calibration.T_imu_lidar
    poses = T @ trajectory.poses @ se3.inverse(T)
    length_m = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    length_m = np.maximum(length_m, _MIN_STEP_LENGTH_M)
    scatter = np.r_[np.full(3, _SCATTER_RAD), np.full(3, _SCATTER_M)]
    drift = np.r_[np.full(3, _DRIFT_RAD_SQRT_M), np.full(3, DRIFT_M_SQRT_M)]
    measured: list[str] = []
    rotation = _rotation(trajectory.stamps_ns, poses, imu, float(np.median(length_m)))
    if rotation is not None:
        scatter[:3], drift[:3] = rotation
        measured.append("rotation")
    translation = _translation(trajectory.stamps_ns, poses, imu)
    if translation is not None:
        scatter[3:] = translation
        measured.append("translation")
    drifts = length_m[:, None] * drift**2
    T_lidar_imu = se3.inverse(T)
    drifts = se3.rotate_covariance(np.array([np.diag(d) for d in drifts]), T_lidar_imu)
    # a step differs by the scatter of both its ends
    scatters = se3.rotate_covariance(np.diag(2 * scatter**2), T_lidar_imu)
    return OdometryNoise(drifts + scatters, drifts, tuple(measured))


def _whole_steps(stamps_ns: Stamps, imu: ImuSamples) -> Mask:
    """Return ``(N-1,)``, true for steps without a gap in the samples."""
    gaps = np.flatnonzero(np.diff(imu.stamps_ns) > _LONGEST_GAP_S * NS_PER_S)
    starts, ends = imu.stamps_ns[gaps], imu.stamps_ns[gaps + 1]
    reached = (stamps_ns[:-1] >= imu.stamps_ns[0]) & (stamps_ns[1:] <= imu.stamps_ns[-1])
    # a gap overlaps a step if it starts before the step's end and ends after the step's start
    overlapping = np.searchsorted(starts, stamps_ns[1:]) - np.searchsorted(ends, stamps_ns[:-1], side="right")
    return np.asarray(reached & (overlapping <= 0))


def _integral(stamps_ns: Stamps, values: Array, at_ns: Stamps) -> Array:
    """Integrate ``(S, 3)`` values, linear between samples, from the first stamp to each of ``at_ns``; ``(M, 3)``."""
    times, at = (stamps_ns - stamps_ns[0]) / NS_PER_S, (at_ns - stamps_ns[0]) / NS_PER_S
    intervals = (values[1:] + values[:-1]) / 2 * np.diff(times)[:, None]
    integral = np.concatenate([np.zeros((1, 3)), np.cumsum(intervals, axis=0)])
    return np.column_stack([np.interp(at, times, column) for column in integral.T])


def _rotation(stamps_ns: Stamps, poses: Array, imu: ImuSamples, length_m: float) -> tuple[Array, Array] | None:
    """Return scatter ``(3,)`` in rad and drift ``(3,)`` in rad per root metre, IMU axes; None with too few samples.

    ``length_m`` is the typical length of a step.
    """
    if len(imu) < 2:
        return None
    whole = _whole_steps(stamps_ns, imu)
    if whole.sum() < _MIN_STEPS:
        return None
    turned = np.diff(_integral(imu.stamps_ns, imu.gyro_rad_s, stamps_ns), axis=0)
    off = turned - se3.so3_log(se3.between(poses[:-1], poses[1:])[:, :3, :3])
    off = off - np.median(off[whole], axis=0)  # the gyroscope's bias times the duration of a step
    sums = np.cumsum(np.vstack([np.zeros(3), np.where(whole[:, None], off, 0.0)]), axis=0)
    runs = np.cumsum(np.r_[0, whole])
    complete = runs[_HORIZON_STEPS:] - runs[:-_HORIZON_STEPS] == _HORIZON_STEPS
    if complete.sum() < _MIN_STEPS:
        return None
    over_one = (off[whole] ** 2).mean(axis=0)
    over_many = ((sums[_HORIZON_STEPS:] - sums[:-_HORIZON_STEPS])[complete] ** 2).mean(axis=0)
    # over_one = drift² + 2·scatter², over_many = horizon·drift² + 2·scatter²
    drift = np.clip((over_many - over_one) / (_HORIZON_STEPS - 1), _MIN_VARIANCE_SHARE * over_one, over_one)
    scatter = np.sqrt(np.maximum((over_one - drift) / 2, _MIN_VARIANCE_SHARE * over_one))
    return scatter, np.sqrt(drift / length_m)


def _translation(stamps_ns: Stamps, poses: Array, imu: ImuSamples) -> Array | None:
    """Return the scatter ``(3,)`` of positions in m, IMU axes; None with too few samples."""
    if len(imu) < 2 or len(stamps_ns) <= _WINDOW_STEPS:
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
    variances = []
    for k in range(0, len(stamps_ns) - _WINDOW_STEPS, _WINDOW_STEPS):
        if whole[k + _WINDOW_STEPS] - whole[k] == _WINDOW_STEPS:
            rows = slice(k, k + _WINDOW_STEPS + 1)
            times = (stamps_ns[rows] - stamps_ns[k]) / NS_PER_S
            off = (poses[rows, :3, 3] - poses[k, :3, 3]) - (place[rows] - place[k])
            # a quadratic takes out start, velocity, gravity and the accelerometer's bias: three parameters per axis
            left = off - np.vander(times, 3) @ np.linalg.lstsq(np.vander(times, 3), off, rcond=None)[0]
            variances.append(((left @ poses[k, :3, :3]) ** 2).sum(axis=0) / (_WINDOW_STEPS + 1 - 3))
    if len(variances) * _WINDOW_STEPS < _MIN_STEPS:
        return None
    return np.asarray(np.sqrt(np.maximum(np.mean(variances, axis=0), _MIN_VARIANCE_M2)))
