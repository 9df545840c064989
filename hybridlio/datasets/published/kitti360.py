"""Reader of KITTI-360 (Liao, Xie and Geiger, "KITTI-360", PAMI 2022; layout by its documentation and scripts).

data_3d_raw/<drive>/velodyne_points/data/NNNNNNNNNN.bin    float32 x y z reflectance
data_3d_raw/<drive>/velodyne_points/timestamps.txt
calibration/calib_cam_to_velo.txt  calibration/calib_cam_to_pose.txt
data_poses/<drive>/poses.txt                               optional: frame number and T_world_imu, 12 numbers
data_poses/<drive>/oxts/…                                  optional: navigation rows; 100 Hz in <drive>'s *_extract
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Index, Stamps
from hybridlio.core.errors import DataError
from hybridlio.core.sensors import ImuSamples
from hybridlio.datasets.kitti.drive_imu import drive_imu, fast_rows
from hybridlio.datasets.kitti.files import KITTI_LIDAR, numbered, read_calibration, rows_of
from hybridlio.datasets.kitti.oxts import read_oxts
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.points.bin_layout import BinLayout
from hybridlio.datasets.published.recording import Layout, Recording
from hybridlio.datasets.published.text import in_order, read_table, read_transform
from hybridlio.datasets.stamps import MISSING_STAMP, read_stamps

# from forward, right, down, the axes of KITTI-360's poses, to forward, left, up, those of navigation rows (KITTI)
_T_FLU_FRD: Array = np.diag([1.0, -1.0, -1.0, 1.0])


def _is_drive(path: Path) -> bool:
    has_scans = (path / "velodyne_points/data").is_dir()
    return has_scans and (path.parent.parent / "calibration/calib_cam_to_velo.txt").is_file()


def _gather(drive: Path, notes: Notes) -> Recording:
    root = drive.resolve().parent.parent
    numbers, paths = numbered(drive / "velodyne_points/data", ".bin")
    lines = read_stamps(drive / "velodyne_points/timestamps.txt")
    if len(numbers) and numbers[-1] >= len(lines):
        raise DataError(f"{drive}: {len(lines)} stamps do not reach scan {paths[-1].name}")
    T_pose_lidar = _T_pose_lidar(root / "calibration")
    poses_folder = root / "data_poses" / drive.name
    imu, is_flu = _imu(poses_folder, notes)
    return Recording(
        folder=drive,
        paths=paths,
        stamps_ns=lines[numbers],
        layout=BinLayout(),
        imu=imu,
        T_imu_lidar=_T_FLU_FRD @ T_pose_lidar if is_flu else T_pose_lidar,
        poses=_poses(poses_folder / "poses.txt", lines, T_pose_lidar, notes),
        lidar=KITTI_LIDAR,
    )


def _T_pose_lidar(folder: Path) -> Array:
    """Return the lidar's pose in the frame of the poses (GPS and IMU; forward, right, down)."""
    file = folder / "calib_cam_to_pose.txt"
    (rows,) = rows_of(read_calibration(file), file, "image_00")
    if rows.shape != (3, 4):
        raise DataError(f"{file}: expected 12 numbers in 'image_00:', found {rows.size}")
    T_pose_camera = se3.check_pose(np.vstack([rows, [0, 0, 0, 1]]), f"{file}: image_00")
    return np.asarray(T_pose_camera @ se3.inverse(read_transform(folder / "calib_cam_to_velo.txt")))


def _imu(folder: Path, notes: Notes) -> tuple[ImuSamples, bool]:
    """Return the samples, and whether their axes are forward, left, up: then the force at rest points along +z."""
    oxts = read_oxts(folder / "oxts", notes) if (folder / "oxts").is_dir() else None
    if oxts is None and not fast_rows(folder).is_dir():
        notes.add(f"no inertial data: {folder / 'oxts'} does not exist")
        return ImuSamples.empty(), True
    imu = drive_imu(folder, oxts, notes)
    is_flu = bool(np.median(imu.accel_m_s2[:, 2]) > 0)
    notes.found(
        f"axes of the inertial data are {'forward, left, up' if is_flu else 'forward, right, down'}, by gravity"
    )
    return imu, is_flu


def _poses(file: Path, lines: Stamps, T_pose_lidar: Array, notes: Notes) -> tuple[Stamps, Array] | None:
    if not file.is_file():
        return None
    frames, values = read_table(file, 0, range(1, 13))
    try:
        rows: Index = np.array([int(frame) for frame in frames])
    except ValueError:
        raise DataError(f"{file}: the first number of a row must be the number of a frame") from None
    known = (rows >= 0) & (rows < len(lines))
    known[known] = lines[rows[known]] != MISSING_STAMP
    poses = np.tile(np.eye(4), (len(values), 1, 1))
    poses[:, :3] = values.reshape(-1, 3, 4)
    checked = np.array([se3.check_pose(pose, f"{file}: pose {k}") for k, pose in enumerate(poses)])
    return in_order(lines[rows[known]], checked[known] @ T_pose_lidar, str(file), notes)


LAYOUT = Layout(
    "KITTI-360: data_3d_raw/<drive>/velodyne_points beside calibration/", _is_drive, _gather, ("*", "data_3d_raw/*")
)
