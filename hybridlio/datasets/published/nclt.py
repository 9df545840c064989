"""Reader of NCLT (Carlevaris-Bianco et al., "University of Michigan North Campus long-term dataset", IJRR 2016).

<date>/velodyne_sync/<microseconds>.bin    uint16 x y z, uint8 intensity and laser, 5 mm a unit from -100 m
<date>/ms25.csv                            optional: microseconds, magnetic field, specific force, angular velocity
ground_truth/groundtruth_<date>.csv        optional, also in <date>: microseconds, x y z, roll pitch heading of the body

Extrinsics are those of the paper's table of sensors. Its frames point down; points are turned to point up.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Stamps
from hybridlio.core.errors import DataError
from hybridlio.core.sensors import ImuSamples
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.points.bin_layout import BinLayout
from hybridlio.datasets.points.fields import Columns
from hybridlio.datasets.published.recording import Layout, Recording
from hybridlio.datasets.published.text import (
    US,
    in_order,
    numbered_files,
    read_imu,
    read_table,
    stamps_of,
    stamps_of_names,
)

_BIN = BinLayout((("x", "<u2"), ("y", "<u2"), ("z", "<u2"), ("intensity", "u1"), ("ring", "u1")))
_SCALE_M, _OFFSET_M = 0.005, -100.0  # the publisher's read_vel_sync.py
_T_DOWN_UP: Array = np.diag([1.0, -1.0, -1.0, 1.0])
_T_BODY_VELODYNE: Array = se3.make(
    Rotation.from_euler("xyz", [0.807, 0.166, -90.703], degrees=True).as_matrix(), [0.002, -0.004, -0.957]
)
_T_BODY_IMU: Array = se3.make(np.eye(3), [-0.11, -0.18, -0.71])  # Microstrain 3DM-GX3-45
T_BODY_LIDAR: Array = np.asarray(_T_BODY_VELODYNE @ _T_DOWN_UP)
T_IMU_LIDAR: Array = np.asarray(se3.inverse(_T_BODY_IMU) @ T_BODY_LIDAR)


def _is_session(path: Path) -> bool:
    return (path / "velodyne_sync").is_dir()


def read_scan(path: Path) -> Columns:
    """Read the columns of a scan, in metres.

    Raises:
        DataError: the file cannot be read, or is truncated.
    """
    columns = _BIN.read(path)
    x, y, z = (columns[axis].astype(np.float32) * np.float32(_SCALE_M) + np.float32(_OFFSET_M) for axis in "xyz")
    return columns | {"x": x, "y": -y, "z": -z}


def _gather(folder: Path, notes: Notes) -> Recording:
    folder = folder.resolve()
    paths = numbered_files(folder / "velodyne_sync", ".bin")
    places = [folder, folder.parent.parent / "sensor_data" / folder.name]
    imu_file = next((p / "ms25.csv" for p in places if (p / "ms25.csv").is_file()), None)
    if imu_file is None:
        notes.add(f"no inertial data: {folder / 'ms25.csv'} does not exist")
    return Recording(
        folder=folder,
        paths=paths,
        stamps_ns=stamps_of_names(paths, US),
        read=read_scan,
        imu=read_imu(imu_file, notes, US, (7, 8, 9), (4, 5, 6)) if imu_file else ImuSamples.empty(),
        T_imu_lidar=T_IMU_LIDAR,
        poses=_poses(folder, notes),
    )


def _poses(folder: Path, notes: Notes) -> tuple[Stamps, Array] | None:
    name = f"groundtruth_{folder.name}.csv"
    places = (folder / name, folder.parent / "ground_truth" / name, folder.parent.parent / "ground_truth" / name)
    file = next((place for place in places if place.is_file()), None)
    if file is None:
        return None
    times, values = read_table(file, 0, range(1, 7))
    known = np.isfinite(values).all(axis=1)  # the published files have rows of NaN
    if not known.any():
        raise DataError(f"{file}: no row of finite numbers")
    rotation = Rotation.from_euler("xyz", values[known, 3:]).as_matrix()
    poses = se3.make(rotation, values[known, :3]) @ T_BODY_LIDAR
    return in_order(stamps_of(file, times, US)[known], poses, str(file), notes)


LAYOUT = Layout("NCLT: a date's folder with velodyne_sync/", _is_session, _gather)
