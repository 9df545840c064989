"""A record for smoothing from an odometry that is not ours: poses, and what else was recorded beside them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.core.estimates import RelativePose
from hybridlio.core.sensors import NS_PER_S, Calibration, GpsFix, ImuNoise, ImuSamples
from hybridlio.core.start_state import start_state
from hybridlio.core.trajectory import Trajectory
from hybridlio.record.odometry_noise import odometry_noise
from hybridlio.record.record import Record

_SOURCE = "odometry"


def record_from_odometry(
    trajectory: Trajectory,
    imu: ImuSamples | None,
    gps: tuple[GpsFix, ...],
    calibration: Calibration | None,
    imu_noise: ImuNoise | None,
    covariances: ArrayLike | None,
) -> Record:
    """See :meth:`hybridlio.record.record.Record.from_odometry`."""
    if len(trajectory) < 2:
        raise DataError(f"a record needs two poses or more, got {len(trajectory)}")
    trajectory, imu = trajectory.from_first(), imu or ImuSamples.empty()
    calibration, imu_noise = calibration or Calibration(), imu_noise or ImuNoise()
    steps = se3.between(trajectory.poses[:-1], trajectory.poses[1:])
    if covariances is None:
        noise = odometry_noise(trajectory, imu, calibration)
        relative = tuple(
            RelativePose(T, c, _SOURCE, drift=d) for T, c, d in zip(steps, noise.covariances, noise.drifts, strict=True)
        )
    else:
        given = _each(covariances, len(steps))
        relative = tuple(RelativePose(T, c, _SOURCE) for T, c in zip(steps, given, strict=True))
    start_ns, end_ns = (int(stamp) for stamp in trajectory.stamps_ns[[0, -1]])
    inside = imu.between(start_ns, end_ns)
    first = inside.stamps_ns <= inside.stamps_ns[0] + NS_PER_S if len(inside) else np.zeros(0, bool)
    beginning = ImuSamples(inside.stamps_ns[first], inside.gyro_rad_s[first], inside.accel_m_s2[first])
    return Record(
        online=Trajectory(trajectory.stamps_ns, trajectory.poses, _accumulated(relative)),
        initial=relative,
        relative=relative,
        imu=inside,
        gps=tuple(sorted(gps or (), key=lambda fix: fix.stamp_ns)),
        start=start_state(start_ns, beginning, imu_noise),
        calibration=calibration,
        imu_noise=imu_noise,
    )


def _each(covariances: ArrayLike, steps: int) -> Array:
    given = np.asarray(covariances, dtype=np.float64)
    given = np.broadcast_to(given, (steps, 6, 6)) if given.shape == (6, 6) else given
    if given.shape != (steps, 6, 6):
        raise DataError(f"step covariances: expected (6, 6), or ({steps}, 6, 6) for {steps + 1} poses: {given.shape}")
    return given


def _accumulated(relative: tuple[RelativePose, ...]) -> Array:
    """Covariances ``(N, 6, 6)`` of the poses as the steps' noise adds up."""
    out = [np.eye(6) * 1e-12]
    for step in relative:
        added = step.covariance if step.drift is None else step.drift
        out.append(se3.compose_covariance(out[-1], step.pose, added))
    return np.array(out)
