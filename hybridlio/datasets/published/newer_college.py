"""Reader of the raw format of Newer College 2020 (Ramezani et al., "The Newer College dataset", IROS 2020).

<experiment>/raw_format/ouster_scan/cloud_<seconds>_<nanoseconds>.pcd    64 beams, column after column
<experiment>/raw_format/ouster_imu/*.csv                                 optional: counter, sec, nsec, rates, forces
<experiment>/ground_truth/registered_poses.csv                           optional: sec, nsec, x y z, qx qy qz qw

Its bags are read by the reader of bags.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.sensors import NS_PER_S, ImuSamples
from hybridlio.datasets.imu_csv import read_imu_csv
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.points.fields import Columns
from hybridlio.datasets.points.point_files import read_columns
from hybridlio.datasets.points.point_times import StatedTimes
from hybridlio.datasets.published.recording import Layout, Recording
from hybridlio.datasets.published.text import read_poses, stamps_of

# Ouster's hardware manual (OS1): the lidar's frame is turned by 180° about z in the sensor's and 36.18 mm above its
# origin; the IMU is at (6.253, -11.775, 7.645) mm. The driver of 2020 publishes points in the lidar's frame.
T_IMU_OUSTER_LIDAR: Array = se3.make(np.diag([-1.0, -1.0, 1.0]), [-0.006253, 0.011775, 0.028535])
# the lidar in the frame of the registered poses, the left camera's base: published calibration, as kiss-icp uses it
_T_BASE_LIDAR: Array = se3.make(Rotation.from_quat([0, 0, 0.924, 0.383]).as_matrix(), [-0.084, -0.025, 0.050])
_BEAMS, _COLUMNS, _SWEEP_S = 64, 1024, 0.1  # OS1-64 at 10 Hz, the paper's table of sensors
_NAME = re.compile(r"cloud_(\d{1,10})_(\d{1,9})\.pcd")


def _is_experiment(path: Path) -> bool:
    return (path / "raw_format/ouster_scan").is_dir()


def read_scan(path: Path) -> Columns:
    """Read the columns of a scan, with the times ``t`` in seconds after its stamp, which follow from their order.

    A scan that lacks points has no known order: its times are zero, so it is not compensated.

    Raises:
        DataError: the file cannot be read.
    """
    columns = dict(read_columns(path))
    count = len(next(iter(columns.values()), ()))
    whole = count == _BEAMS * _COLUMNS
    order = np.arange(count)
    return columns | {"t": order // _BEAMS * (_SWEEP_S / _COLUMNS) if whole else np.zeros(count)}


def _gather(folder: Path, notes: Notes) -> Recording:
    scans = folder / "raw_format/ouster_scan"
    named = [(match, path) for path in scans.glob("cloud_*.pcd") if (match := _NAME.fullmatch(path.name))]
    named.sort(key=lambda one: (int(one[0][1]), int(one[0][2])))
    imu_file = next(iter(sorted((folder / "raw_format/ouster_imu").glob("*.csv"))), None)
    if imu_file is None:
        notes.add(f"no inertial data: no CSV file in {folder / 'raw_format/ouster_imu'}")
    pose_file = folder / "ground_truth/registered_poses.csv"
    poses = read_poses(pose_file, notes, NS_PER_S, (0, 1), 2) if pose_file.is_file() else None
    return Recording(
        folder=folder,
        paths=tuple(path for _, path in named),
        stamps_ns=stamps_of(scans, [f"{m[1]}.{int(m[2]):09d}" for m, _ in named], NS_PER_S),
        read=read_scan,
        times=StatedTimes("t", "s", "stamp"),
        imu=read_imu_csv(imu_file, notes) if imu_file else ImuSamples.empty(),
        T_imu_lidar=T_IMU_OUSTER_LIDAR,
        poses=poses and (poses[0], poses[1] @ _T_BASE_LIDAR),
    )


LAYOUT = Layout("Newer College 2020: an experiment's folder with raw_format/ouster_scan/", _is_experiment, _gather)
