"""GPS fixes in the frame of a trajectory."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import EstimationError
from hybridlio.core.pose_interpolation import PosePath
from hybridlio.core.trajectory import Trajectory
from hybridlio.record.record import Record
from hybridlio.smoothing.georeference import georeference
from hybridlio.smoothing.gps_alignment import fix_stamps
from hybridlio.viewing.scene import PlacedFixes


def place_fixes(record: Record, trajectory: Trajectory) -> PlacedFixes | None:
    """Return the fixes of a run, aligned with a trajectory as a whole; None where too few lie in its time."""
    if not record.gps:
        return None
    try:
        found = georeference(record, trajectory).alignment
    except EstimationError:  # fewer than three fixes
        return None
    wrong = np.flatnonzero(found.used & ~found.inliers).tolist()
    return placed_by(record, trajectory, found.T_enu_world, found.shift_s, wrong)


def placed_by(
    record: Record, trajectory: Trajectory, T_enu_world: Array, shift_s: float, rejected: Collection[int]
) -> PlacedFixes:
    """Return the fixes in a trajectory's time, by a known alignment and shift of the clocks, such as smoothing's.

    Args:
        record: of the run.
        trajectory: lidar poses.
        T_enu_world: ``(4, 4)``.
        shift_s: a fix stamped ``t`` is of the antenna at ``t + shift_s``.
        rejected: the rows of fixes that are taken for wrong.
    """
    path = PosePath(trajectory.stamps_ns, trajectory.poses)
    stamps = fix_stamps(record.gps, shift_s)
    rows = np.flatnonzero(path.covers(stamps))
    antenna = record.calibration.antenna_imu_m
    lever = se3.transform(
        se3.inverse(record.calibration.T_imu_lidar), np.zeros((1, 3)) if antenna is None else antenna[None]
    )[0]
    antennas = path.points(stamps[rows], lever)[0]
    enu = np.array([record.gps[row].position_m for row in rows]).reshape(-1, 3)
    sigmas = np.array([np.sqrt(np.trace(record.gps[row].covariance_m2)) for row in rows])
    return PlacedFixes(
        stamps[rows],
        se3.transform(se3.inverse(T_enu_world), enu),
        antennas,
        se3.transform(T_enu_world, antennas) - enu,
        sigmas,
        np.isin(rows, list(rejected)),
        T_enu_world,
        record.origin,
    )
