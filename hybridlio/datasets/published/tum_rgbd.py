"""Reader of TUM RGB-D (Sturm et al., IROS 2012; layout by the benchmark's page on file formats).

rgbd_dataset_<name>/depth.txt        a time in seconds and the name of an image, a row a frame
rgbd_dataset_<name>/depth/*.png      480 x 640, 16 bits, 5000 to a metre, 0 where nothing is measured
rgbd_dataset_<name>/groundtruth.txt  optional: seconds, position and quaternion x y z w of the camera

The points are turned from the camera's axes (z ahead) to a lidar's (x ahead, z up). Intrinsics are those of the
Kinect's driver, for which the images were scaled. There is an accelerometer but no gyroscope, so no IMU is used.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hybridlio.core import se3
from hybridlio.core.errors import DataError
from hybridlio.core.sensors import NS_PER_S
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.points.fields import Columns
from hybridlio.datasets.published.recording import Layout, Recording
from hybridlio.datasets.published.text import read_poses, read_table, stamps_of

_SHAPE = (480, 640)
_FOCAL_PX, _CENTRE_PX = 525.0, (319.5, 239.5)
_UNITS_PER_M = 5000.0
_R_LIDAR_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
_T_CAMERA_LIDAR = se3.make(_R_LIDAR_CAMERA.T, np.zeros(3))


def _is_recording(path: Path) -> bool:
    return (path / "depth.txt").is_file() and (path / "depth").is_dir()


def _gather(folder: Path, notes: Notes) -> Recording:
    index, poses = folder / "depth.txt", folder / "groundtruth.txt"
    times, _ = read_table(index, 0, (0,))
    names = [line.split()[1:2] for line in index.read_text(encoding="utf-8-sig").splitlines() if _is_row(line)]
    if not all(names):
        raise DataError(f"{index}: a row names no image")
    notes.add("no inertial data: TUM RGB-D has an accelerometer but no gyroscope")
    reference = None
    if poses.is_file():
        stamps, cameras = read_poses(poses, notes, NS_PER_S)
        reference = stamps, np.asarray(cameras @ _T_CAMERA_LIDAR)
    return Recording(
        folder=folder,
        paths=tuple(folder / name[0] for name in names),
        stamps_ns=stamps_of(index, times, NS_PER_S),
        read=read_depth,
        poses=reference,
    )


def _is_row(line: str) -> bool:
    return bool(line.split()) and not line.lstrip().startswith("#")


def read_depth(path: Path) -> Columns:
    """Return the points of a depth image, x ahead and z up.

    Raises:
        DataError: it is no such image.
    """
    from PIL import Image

    try:
        with Image.open(path) as image:
            units = np.asarray(image)
    except (OSError, ValueError, SyntaxError) as error:  # Pillow raises SyntaxError for damaged PNG chunks
        raise DataError(f"cannot be read as an image ({str(error)[:160]})") from None
    if units.shape != _SHAPE or units.dtype.kind not in "iu":
        raise DataError(f"expected an image of {_SHAPE[0]} x {_SHAPE[1]} whole numbers, found {units.shape}")
    rows, columns = np.nonzero(units)
    ahead = units[rows, columns] / _UNITS_PER_M
    right = (columns - _CENTRE_PX[0]) / _FOCAL_PX * ahead
    down = (rows - _CENTRE_PX[1]) / _FOCAL_PX * ahead
    return {"x": ahead, "y": -right, "z": -down}


LAYOUT = Layout("TUM RGB-D: a recording's folder with depth.txt and depth/", _is_recording, _gather)
