"""The lidar's path during one sweep, from poses at the scans and the gyroscope between them."""

from __future__ import annotations

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Stamps
from hybridlio.core.pose_interpolation import PosePath
from hybridlio.core.sensors import NS_PER_S, Calibration, ImuSamples, Scan
from hybridlio.core.trajectory import Trajectory

_STEP_NS = 10_000_000  # between knots without a gyroscope; poses of a vehicle are smooth over 10 ms
_MIN_SAMPLES = 3  # one inside the interval between two poses; fewer add nothing to the poses themselves


def sweep_path(path: PosePath, scan: Scan, imu: ImuSamples, calibration: Calibration) -> Trajectory:
    """Return lidar poses in the world frame throughout the sweep of a scan, for :func:`hybridlio.cloud.deskew.deskew`.

    Positions come from the spline through the poses. Rotations come from the gyroscope where there is one: its rates
    are integrated between the poses before and after the sweep, and what the integral misses of their relative
    rotation, the gyroscope's bias above all, is spread evenly over that time.

    Args:
        path: poses ``T_world_lidar`` at the scans, of any odometry.
        scan: a scan whose points have times.
        imu: all samples of the recording; may be empty.
        calibration: extrinsics of the IMU.

    Returns:
        Two or more poses; where the sweep begins before the first pose or ends after the last, they do not cover it,
        and ``deskew`` continues the motion.
    """
    offsets = scan.time_offsets_ns
    assert offsets is not None
    start, end = _bracket(path.stamps_ns, scan.stamp_ns + int(offsets.min()), scan.stamp_ns + int(offsets.max()))
    samples = imu.between(start, end)
    if len(samples) >= _MIN_SAMPLES:
        stamps, rotations = samples.stamps_ns, _integrated_rotations(path, samples, calibration)
    else:
        stamps = np.append(np.arange(start, end, _STEP_NS, dtype=np.int64), end)
        rotations = path.at(stamps)[:, :3, :3]
    return Trajectory(stamps, se3.make(rotations, path.at(stamps)[:, :3, 3]))


def _bracket(stamps_ns: Stamps, first_ns: int, last_ns: int) -> tuple[int, int]:
    """Return the stamps of the last pose before a sweep and the first after it; at the ends, of the nearest two."""
    before = max(int(np.searchsorted(stamps_ns, first_ns, side="right")) - 1, 0)
    after = min(int(np.searchsorted(stamps_ns, last_ns, side="left")), len(stamps_ns) - 1)
    before = min(before, len(stamps_ns) - 2)
    return int(stamps_ns[before]), int(stamps_ns[max(after, before + 1)])


def _integrated_rotations(path: PosePath, samples: ImuSamples, calibration: Calibration) -> Array:
    """Return ``R_world_lidar`` ``(S, 3, 3)`` at the samples, which agree with the path at the first and the last."""
    rates = samples.gyro_rad_s @ calibration.T_imu_lidar[:3, :3]
    times_s = (samples.stamps_ns - samples.stamps_ns[0]) / NS_PER_S
    turns = se3.so3_exp((rates[1:] + rates[:-1]) / 2 * np.diff(times_s)[:, None])
    integrated = [np.eye(3)]
    for turn in turns:
        integrated.append(integrated[-1] @ turn)
    R_start, R_end = path.at(samples.stamps_ns[[0, -1]])[:, :3, :3]
    missed = se3.so3_log(integrated[-1].T @ R_start.T @ R_end)
    corrections = se3.so3_exp(times_s[:, None] / times_s[-1] * missed)
    return np.asarray(R_start @ np.array(integrated) @ corrections)
