"""Reader of MulRan (Kim et al., "MulRan: multimodal range dataset for urban place recognition", ICRA 2020).

<sequence>/Ouster/<nanoseconds>.bin    float32 x y z intensity; column after column, 64 beams each
<sequence>/xsens_imu.csv               optional: nanoseconds, quaternion, angles, angular velocity, specific force, …
<sequence>/global_pose.csv             optional: nanoseconds and 12 numbers of the vehicle's base in the world

Ouster/ and xsens_imu.csv may also lie in <sequence>/sensor_data. Columns are those of the publisher's file player.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.sensors import ImuSamples
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.points.bin_layout import BinLayout
from hybridlio.datasets.points.fields import Columns
from hybridlio.datasets.points.point_times import StatedTimes
from hybridlio.datasets.published.recording import Layout, Recording
from hybridlio.datasets.published.text import numbered_files, read_matrices, read_xsens, stamps_of_names

# the publisher's calib_base2ouster.txt: roll, pitch and yaw in degrees
_R_BASE_LIDAR: Array = Rotation.from_euler("xyz", [0.0001, 0.0003, 179.6654], degrees=True).as_matrix()
T_BASE_LIDAR: Array = se3.make(_R_BASE_LIDAR, [1.7042, -0.021, 1.8047])
# The publisher does not say where the IMU is. LIO-SAM's users of this data set take this lever arm, and axes parallel
# to the vehicle's.
T_IMU_LIDAR: Array = se3.make(_R_BASE_LIDAR, [1.77, 0.0, -0.05])
_BEAMS, _COLUMNS, _SWEEP_S = 64, 1024, 0.1  # OS1-64 at 10 Hz, the paper's table of sensors


def _is_sequence(path: Path) -> bool:
    places = ("Ouster", "sensor_data/Ouster")
    return path.name not in ("LiDAR", "sensor_data") and any((path / place).is_dir() for place in places)


def read_scan(path: Path) -> Columns:
    """Read the columns of a scan, with the times ``t`` in seconds after its stamp, which follow from their order.

    A scan that lacks points, as after a lost packet, has no known order: its times are zero, so it is not compensated.

    Raises:
        DataError: the file cannot be read, or is truncated.
    """
    columns = BinLayout().read(path)
    order = np.arange(len(columns["x"]))
    whole = len(order) == _BEAMS * _COLUMNS
    return columns | {"t": order // _BEAMS * (_SWEEP_S / _COLUMNS) if whole else np.zeros(len(order))}


def _gather(folder: Path, notes: Notes) -> Recording:
    data = folder if (folder / "Ouster").is_dir() else folder / "sensor_data"
    paths = numbered_files(data / "Ouster", ".bin")
    imu_file, pose_file = (
        next((p / name for p in (folder, data) if (p / name).is_file()), None)
        for name in ("xsens_imu.csv", "global_pose.csv")
    )
    if imu_file is None:
        notes.add(f"no inertial data: {data / 'xsens_imu.csv'} does not exist")
    else:
        notes.add("the IMU's place is not published: T_imu_lidar is that of other users; calibration.yaml overrides it")
    stamps, poses = read_matrices(pose_file, notes, 1) if pose_file else (None, None)
    return Recording(
        folder=folder,
        paths=paths,
        stamps_ns=stamps_of_names(paths, 1),
        read=read_scan,
        times=StatedTimes("t", "s", "stamp"),
        imu=read_xsens(imu_file, notes) if imu_file else ImuSamples.empty(),
        T_imu_lidar=T_IMU_LIDAR,
        poses=None if stamps is None or poses is None else (stamps, poses @ T_BASE_LIDAR),
    )


LAYOUT = Layout("MulRan: a sequence's folder with Ouster/", _is_sequence, _gather)
