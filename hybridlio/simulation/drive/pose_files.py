"""Pose files to drive along, KITTI or TUM format, read as lidar poses every 0.1 s with the z axis up."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.core.trajectory import Trajectory, is_tum_file, read_trajectory
from hybridlio.simulation.drive.path import SmoothPath
from hybridlio.simulation.rig import SCAN_RATE_HZ, T_CAMERA_LIDAR, T_LIDAR_IMU

KNOT_S = 0.3  # three poses per knot: averages the noise of recorded poses, follows all that a car does
MARGIN_STEPS = 10  # a second at either end, for the IMU's lead and the derivatives at the ends
_MIN_POSES = 10  # enough for the twist at both ends
_TWIST_STEPS = 5  # half a second, over which the twist at an end is averaged


def read_lidar_poses(path: Path, frame: str) -> Array:
    """Read lidar poses ``(N, 4, 4)``, one every 0.1 s, in a world whose z axis is the mean of the lidar's.

    Args:
        path: KITTI format (12 numbers a row, 0.1 s apart) or TUM format (time, position, quaternion x y z w).
        frame: what the poses of a KITTI file are of, ``camera`` or ``lidar``.

    Raises:
        DataError: as :func:`hybridlio.core.trajectory.read_trajectory`, or fewer than 10 poses.
    """
    recorded, is_tum = read_trajectory(path), is_tum_file(path)
    if len(recorded) < _MIN_POSES:
        raise DataError(f"{path}: {len(recorded)} poses; a drive needs at least {_MIN_POSES}")
    if is_tum:
        return _upright(_evenly(recorded))
    return _upright(recorded.poses @ T_CAMERA_LIDAR if frame == "camera" else recorded.poses)


def _evenly(recorded: Trajectory) -> Array:
    """Return the poses interpolated every 0.1 s from the first."""
    times = recorded.times_s
    at = np.arange(0.0, times[-1] + 1e-9, 1.0 / SCAN_RATE_HZ)
    attitude = Slerp(times, Rotation.from_matrix(recorded.poses[:, :3, :3]))(at).as_matrix()
    position = np.column_stack([np.interp(at, times, column) for column in recorded.poses[:, :3, 3].T])
    return se3.make(attitude, position)


def _upright(poses: Array) -> Array:
    """Return the poses in a world at the first position, whose z axis is the mean of the lidar's."""
    up = poses[:, :3, 2].mean(axis=0)
    up /= np.linalg.norm(up)
    ahead = poses[0, :3, 0] - up * (up @ poses[0, :3, 0])
    ahead /= np.linalg.norm(ahead)
    T_start_world = se3.make(np.column_stack([ahead, np.cross(up, ahead), up]), poses[0, :3, 3])
    return se3.between(T_start_world, poses)


def path_along(lidar_poses: Array) -> SmoothPath:
    """Fit the IMU's path to lidar poses ``(N, 4, 4)`` at 0, 0.1, 0.2 … s, extended by a second at either end."""
    first, last = (
        se3.log(se3.between(lidar_poses[i], lidar_poses[i + _TWIST_STEPS])) / _TWIST_STEPS
        for i in (0, len(lidar_poses) - 1 - _TWIST_STEPS)
    )
    before = lidar_poses[0] @ se3.exp(np.arange(-MARGIN_STEPS, 0)[:, None] * first)
    after = lidar_poses[-1] @ se3.exp(np.arange(1, MARGIN_STEPS + 1)[:, None] * last)
    poses = np.concatenate([before, lidar_poses, after]) @ T_LIDAR_IMU
    return SmoothPath.near(np.arange(-MARGIN_STEPS, len(lidar_poses) + MARGIN_STEPS) / SCAN_RATE_HZ, poses, KNOT_S)
