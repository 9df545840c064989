"""Reader of Argoverse 2 (Wilson et al., NeurIPS 2021 Datasets; layout by its development kit av2).

<log>/sensors/lidar/<nanoseconds>.feather    points in the vehicle's frame, already compensated to the stamp
<log>/city_SE3_egovehicle.feather            optional: nanoseconds, qw qx qy qz, tx_m ty_m tz_m

The frame of the points, and of the odometry, is the vehicle's; there are no inertial data.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hybridlio.core.arrays import Array, Stamps
from hybridlio.core.errors import DataError
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.points.tables import read_arrow
from hybridlio.datasets.published.recording import Layout, Recording
from hybridlio.datasets.published.text import in_order, numbered_files, poses_of, stamps_of_names

_POSE = ("qx", "qy", "qz", "qw", "tx_m", "ty_m", "tz_m")


def _is_log(path: Path) -> bool:
    return (path / "sensors/lidar").is_dir()


def _gather(folder: Path, notes: Notes) -> Recording:
    paths, file = numbered_files(folder / "sensors/lidar", ".feather"), folder / "city_SE3_egovehicle.feather"
    notes.add("no inertial data: Argoverse 2 publishes none")
    notes.found("points are in the vehicle's frame and compensated by the publisher; their times are not used")
    return Recording(
        folder=folder,
        paths=paths,
        stamps_ns=stamps_of_names(paths, 1),
        poses=_poses(file, notes) if file.is_file() else None,
    )


def _poses(file: Path, notes: Notes) -> tuple[Stamps, Array]:
    try:
        columns = read_arrow(file)
    except DataError as error:
        raise DataError(f"{file}: {error}") from None
    if missing := [name for name in ("timestamp_ns", *_POSE) if name not in columns]:
        raise DataError(f"{file}: no column {missing[0]}; found {', '.join(columns) or 'none'}")
    values = np.column_stack([np.asarray(columns[name], dtype=np.float64) for name in _POSE])
    stamps = columns["timestamp_ns"]
    if stamps.dtype.kind not in "iu" or not len(stamps):
        raise DataError(f"{file}: timestamp_ns must be whole nanoseconds")
    return in_order(stamps.astype(np.int64), poses_of(values[:, 4:], values[:, :4], str(file)), str(file), notes)


LAYOUT = Layout("Argoverse 2: a log's folder with sensors/lidar/", _is_log, _gather)
