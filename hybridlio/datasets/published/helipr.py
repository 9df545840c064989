"""Reader of HeLiPR (Jung et al., "HeLiPR: heterogeneous lidar dataset", IJRR 2024; files by its file player).

<sequence>/LiDAR/<sensor>/<nanoseconds>.bin      Ouster, Velodyne, Aeva or Avia; each has columns of its own
<sequence>/Inertial_data/xsens_imu.csv           optional: as of MulRan
<sequence>/LiDAR_GT/<sensor>_gt.txt              optional, or global_<sensor>_gt.txt: nanoseconds, x y z, qx qy qz qw

Each sensor is a recording of its own.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.sensors import ImuSamples
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.points.bin_layout import BinLayout
from hybridlio.datasets.points.fields import Columns
from hybridlio.datasets.points.point_times import StatedTimes
from hybridlio.datasets.published.recording import Layout, Recording
from hybridlio.datasets.published.text import numbered_files, read_poses, read_xsens, stamps_of_names

_XYZ = (("x", "<f4"), ("y", "<f4"), ("z", "<f4"))
_AEVA = (*_XYZ, ("_reflectivity", "<f4"), ("_velocity", "<f4"), ("t", "<i4"), ("_line", "u1"))
_COLUMNS = {
    "Ouster": BinLayout((*_XYZ, ("intensity", "<f4"), ("t", "<u4"), *((f"_{k}", "<u2") for k in range(3)))),
    "Velodyne": BinLayout((*_XYZ, ("intensity", "<f4"), ("ring", "<u2"), ("t", "<f4"))),
    "Aeva": BinLayout((*_AEVA, ("intensity", "<f4"))),
    "Avia": BinLayout((*_XYZ, ("intensity", "u1"), ("_tag", "u1"), ("_line", "u1"), ("t", "<u4"))),
}
_AEVA_OLD = BinLayout(_AEVA)
_AEVA_OLD_UNTIL_NS = 1691936557946849179  # scans up to this stamp lack the intensity, as the file player knows
_UNITS = {"Ouster": "ns", "Velodyne": "s", "Aeva": "ns", "Avia": "ns"}
# The publisher's calibration, as evalio (github.com/contagon/evalio) and its pipelines use it. Those of the other
# sensors could not be verified.
T_IMU_OUSTER: Array = se3.orthonormalise(
    np.array(
        [
            [0.999715495593027, 0.0223448061210468, -0.00834490926264448, -0.41696532],
            [-0.0224514077723064, 0.999664614804883, -0.0129070599303583, -0.00301141],
            [0.00805370475188661, 0.0130907427756056, 0.999881878170293, 0.2996],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
)


def _is_sensor(path: Path) -> bool:
    return path.name in _COLUMNS and path.parent.name == "LiDAR" and path.is_dir()


def read_aeva(path: Path) -> Columns:
    """Read the columns of a scan of the Aeva, which early scans have without intensity.

    Raises:
        DataError: the file cannot be read, or is truncated.
    """
    is_old = path.stem.isdecimal() and int(path.stem) <= _AEVA_OLD_UNTIL_NS
    return (_AEVA_OLD if is_old else _COLUMNS["Aeva"]).read(path)


def _gather(folder: Path, notes: Notes) -> Recording:
    folder = folder.resolve()
    sensor, sequence = folder.name, folder.parent.parent
    paths = numbered_files(folder, ".bin")
    truth = [sequence / "LiDAR_GT" / f"{part}{sensor}_gt.txt" for part in ("", "global_")]
    pose_file = next((file for file in truth if file.is_file()), None)
    return Recording(
        folder=sequence,
        paths=paths,
        stamps_ns=stamps_of_names(paths, 1),
        layout=_COLUMNS[sensor],
        read=read_aeva if sensor == "Aeva" else None,
        times=StatedTimes("t", _UNITS[sensor], "stamp"),
        imu=_imu(sequence, sensor, notes),
        T_imu_lidar=T_IMU_OUSTER if sensor == "Ouster" else np.eye(4),
        poses=read_poses(pose_file, notes, 1) if pose_file else None,
    )


def _imu(sequence: Path, sensor: str, notes: Notes) -> ImuSamples:
    file = sequence / "Inertial_data/xsens_imu.csv"
    mounted = sensor == "Ouster" or (sequence / "calibration.yaml").is_file()
    if not file.is_file():
        notes.add(f"no inertial data: {file} does not exist")
    elif not mounted:
        notes.add(
            f"no inertial data: only the Ouster's place is built in; write T_imu_lidar of the {sensor} to "
            f"{sequence / 'calibration.yaml'}"
        )
    return read_xsens(file, notes) if file.is_file() and mounted else ImuSamples.empty()


LAYOUT = Layout(
    "HeLiPR: a sequence's folder with LiDAR/Ouster, Velodyne, Aeva or Avia", _is_sensor, _gather, ("LiDAR/*",)
)
