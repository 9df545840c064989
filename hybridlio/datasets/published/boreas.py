"""Reader of Boreas (Burnett et al., IJRR 2023; layout by pyboreas's DATA_REFERENCE.md).

boreas-<date>/lidar/<microseconds>.bin       float32 x y z intensity laser time; seconds after the stamp, the middle
boreas-<date>/applanix/lidar_poses.csv       optional: microseconds, x y z, velocity, roll pitch yaw, rates

The published inertial data lack gravity (github.com/utiasASRL/pyboreas, issue 24), so they are not used.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Stamps
from hybridlio.core.errors import DataError
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.points.bin_layout import BinLayout
from hybridlio.datasets.points.point_times import StatedTimes
from hybridlio.datasets.published.recording import Layout, Recording
from hybridlio.datasets.published.text import US, in_order, numbered_files, read_table, stamps_of, stamps_of_names

_BIN = BinLayout(tuple((name, "<f4") for name in ("x", "y", "z", "intensity", "ring", "t")))


def _is_sequence(path: Path) -> bool:
    return (path / "lidar").is_dir() and ((path / "applanix").is_dir() or path.name.startswith("boreas-"))


def _gather(folder: Path, notes: Notes) -> Recording:
    paths, pose_file = numbered_files(folder / "lidar", ".bin"), folder / "applanix/lidar_poses.csv"
    notes.add("no inertial data: Boreas publishes specific forces without gravity, which odometry needs")
    return Recording(
        folder=folder,
        paths=paths,
        stamps_ns=stamps_of_names(paths, US),
        layout=_BIN,
        times=StatedTimes("t", "s", "stamp"),
        poses=_poses(pose_file, notes) if pose_file.is_file() else None,
    )


def _poses(file: Path, notes: Notes) -> tuple[Stamps, Array]:
    """Return stamps and poses; the rotation is pyboreas's, of negative angles (``yawPitchRollToRot``)."""
    times, values = read_table(file, 0, (1, 2, 3, 7, 8, 9))
    if not np.isfinite(values).all():
        raise DataError(f"{file}: expected finite numbers")
    roll_pitch_yaw = -values[:, 3:]
    rotation = Rotation.from_euler("XYZ", roll_pitch_yaw).as_matrix()  # Rx(-roll) Ry(-pitch) Rz(-yaw)
    return in_order(stamps_of(file, times, US), se3.make(rotation, values[:, :3]), str(file), notes)


LAYOUT = Layout("Boreas: a sequence's folder with lidar/ and applanix/", _is_sequence, _gather, ("boreas-*",))
