"""Reader of plain folders: scans in natural order, a file of stamps, an IMU CSV and a calibration.

recording/
    scans/*                      of one kind, see `points.point_files`; also in lidar/, points/, velodyne/, data/,
                                 or directly in recording/
    timestamps.txt or times.txt  one stamp per scan, see `stamps.read_stamps`
    imu.csv                      optional, see `imu_csv`
    calibration.yaml             needed with imu.csv, see `read_calibration_yaml`
    poses_tum.txt                optional reference: lidar poses on the scans' clock, TUM format
    gps.csv                      optional, see `gps_csv`
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Stamps
from hybridlio.core.errors import DataError
from hybridlio.core.files import read_yaml
from hybridlio.core.lidar_models import LIDAR_MODELS, LidarModel
from hybridlio.core.sensors import Calibration, ImuSamples
from hybridlio.core.trajectory_files import read_tum
from hybridlio.datasets.gps_csv import note_fixes, read_gps_csv
from hybridlio.datasets.imu_csv import read_imu_csv
from hybridlio.datasets.kitti.vertical_angle import raised
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.points.point_files import SUFFIXES, open_point_files
from hybridlio.datasets.reference import poses_at
from hybridlio.datasets.sequence import Sequence
from hybridlio.datasets.stamps import (
    MISSING_STAMP,
    SCAN_GAP_FACTOR,
    note_coverage,
    note_gaps,
    read_stamps,
    usable_scans,
)

LAYOUT = "a folder with timestamps.txt, and scans .bin, .npy, .pcd or .ply in it or in scans/"

_SCAN_FOLDERS = ("scans", "lidar", "points", "velodyne", "data", ".")  # the folder itself last: a map may be in it
_MAX_LEVER_ARM_M = 20.0  # from IMU to lidar on any vehicle; more is another unit, such as millimetres
_MAX_UPSIDE_DOWN = -0.5  # cosine of the angle between the specific force and the lidar's z axis: 120°, no hill
_STAMP_FILES = ("timestamps.txt", "times.txt")
_HOW_TO_CALIBRATE = (
    "write the transform T_imu_lidar, which maps lidar points into the IMU's frame, such as\n"
    "T_imu_lidar:\n  - [1, 0, 0, 0.1]\n  - [0, 1, 0, 0.0]\n  - [0, 0, 1, 0.3]\n  - [0, 0, 0, 1]"
)


def find(path: Path) -> dict[str, Path]:
    """Find the recording at ``path``, or those in the folders directly below: folders by name."""
    here = [path] if _scan_files(path) else sorted(p for p in path.glob("*") if _stamp_files(p) and _scan_files(p))
    return {p.resolve().name: p for p in here}


def open_folder(folder: Path, raw_root: Path | None = None, vertical_angle_deg: float | None = None) -> Sequence:
    """Open one recording in the layout above.

    Args:
        folder: the recording's folder.
        raw_root: not used.
        vertical_angle_deg: angle by which points are raised; none by default.

    Raises:
        DataError: stamps are missing or not one per scan, ``imu.csv`` has no ``T_imu_lidar``, or a file is malformed;
            the message says what to write.
        ConfigError: ``vertical_angle_deg`` is over 5°.
    """
    del raw_root
    folder = folder.resolve()
    notes = Notes(folder.name)
    stamps, paths = _stamped(folder, _scan_files(folder), notes)
    imu = read_imu_csv(folder / "imu.csv", notes) if (folder / "imu.csv").is_file() else ImuSamples.empty()
    calibration, lidar = read_calibration_yaml(folder / "calibration.yaml", needs_imu=len(imu) > 0)
    if len(imu):
        _note_mounting(imu, calibration.T_imu_lidar, notes)
    else:
        notes.add(f"no inertial data: {folder / 'imu.csv'} does not exist")
    note_coverage(imu.stamps_ns, stamps, "inertial data", notes)
    gps = read_gps_csv(folder / "gps.csv")
    note_fixes(gps, stamps, notes)
    poses = read_tum(folder / "poses_tum.txt") if (folder / "poses_tum.txt").is_file() else None
    return Sequence(
        name=folder.name,
        stamps_ns=stamps,
        load_scan=raised(open_point_files(paths, stamps, notes), vertical_angle_deg),
        imu=imu,
        calibration=calibration,
        reference=poses_at(stamps, poses.stamps_ns, poses.poses, "rows of poses_tum.txt", notes) if poses else None,
        gps=gps,
        lidar=lidar,
        notes=tuple(notes.texts),
    )


def _natural(path: Path) -> list[Any]:
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path.name)]


def _stamp_files(folder: Path) -> list[Path]:
    return [folder / name for name in _STAMP_FILES if (folder / name).is_file()]


def _scan_files(folder: Path) -> tuple[Path, ...]:
    """Return the scan files of a recording in natural order, from the first of the known folders that has any."""
    for name in _SCAN_FOLDERS:
        found = [p for p in (folder / name).glob("*") if p.suffix in SUFFIXES and not p.name.startswith(".")]
        if found:
            return tuple(sorted(found, key=_natural))
    return ()


def _stamped(folder: Path, paths: tuple[Path, ...], notes: Notes) -> tuple[Stamps, tuple[Path, ...]]:
    """Return stamps and files of the scans, without those whose stamps do not increase."""
    if not paths:
        raise DataError(f"{folder}: no scans ({', '.join(SUFFIXES)})")
    suffixes = sorted({p.suffix for p in paths})
    if len(suffixes) > 1:
        raise DataError(f"{paths[0].parent}: scans of several kinds ({', '.join(suffixes)}); keep one kind per folder")
    files = _stamp_files(folder)
    if not files:
        raise DataError(
            f"{folder}: no {' or '.join(_STAMP_FILES)}; write one stamp per line, in seconds, for each scan"
        )
    stamps = read_stamps(files[0])
    if len(stamps) != len(paths) or (stamps == MISSING_STAMP).any():
        raise DataError(f"{files[0]}: {len(stamps)} lines for {len(paths)} scans; each scan needs one stamp")
    keep = usable_scans(stamps, files[0])
    if len(keep) < len(paths):
        first = paths[int(np.setdiff1d(np.arange(len(paths)), keep)[0])].name
        notes.add(f"dropped {len(paths) - len(keep)} scans whose stamps repeat or go backwards, first {first}")
    note_gaps(stamps[keep], "scans", notes, SCAN_GAP_FACTOR)
    return stamps[keep], tuple(paths[k] for k in keep)


def _note_mounting(imu: ImuSamples, T_imu_lidar: Array, notes: Notes) -> None:
    """Note extrinsics that contradict the samples: lengths in another unit, or gravity that points up."""
    distance_m = float(np.linalg.norm(T_imu_lidar[:3, 3]))
    if distance_m > _MAX_LEVER_ARM_M:
        notes.add(f"T_imu_lidar: the lidar is {distance_m:g} m from the IMU; the last column must be in metres")
    force = T_imu_lidar[:3, :3].T @ np.median(imu.accel_m_s2, axis=0)
    if force[2] < _MAX_UPSIDE_DOWN * np.linalg.norm(force):
        notes.add(
            "the specific force points down in the lidar's frame, whose z axis must be up; check T_imu_lidar, and that "
            "the accelerometer at rest reads +9.81 on the axis that points up"
        )


def read_calibration_yaml(path: Path, needs_imu: bool = False) -> tuple[Calibration, LidarModel | None]:
    """Read extrinsics and lidar from a ``calibration.yaml``.

    Keys, all optional: ``T_imu_lidar`` and ``T_camera_lidar``, four rows of four numbers in metres; ``antenna_imu_m``,
    the GPS antenna in the IMU frame, three numbers; ``lidar``, a name of
    :data:`hybridlio.core.sensors.LIDAR_MODELS`. Without ``T_imu_lidar`` it is the identity, the others are None.

    Args:
        path: the file, which need not exist.
        needs_imu: whether there are inertial data, which need ``T_imu_lidar``.

    Raises:
        DataError: the file is not YAML, a key or lidar is unknown, a value has another shape, a matrix is no rigid
            transform, or ``T_imu_lidar`` is needed and missing.
    """
    content = read_yaml(path) if path.is_file() else {}
    known = ("T_imu_lidar", "T_camera_lidar", "lidar", "antenna_imu_m")
    if not isinstance(content, dict):
        raise DataError(f"{path}: expected a mapping; {_HOW_TO_CALIBRATE}")
    if unknown := [key for key in content if key not in known]:
        raise DataError(f"{path}: unknown key {unknown[0]!r}; the keys are {', '.join(known)}")
    lidar = content.get("lidar")
    if lidar is not None and str(lidar) not in LIDAR_MODELS:
        raise DataError(f"{path}: unknown lidar {lidar!r}; known: {', '.join(LIDAR_MODELS)}")
    T_imu_lidar, T_camera_lidar = (_matrix(path, name, content.get(name)) for name in known[:2])
    if T_imu_lidar is None and needs_imu:
        what = "lacks T_imu_lidar" if path.is_file() else "missing"
        raise DataError(f"{path}: {what}, and imu.csv needs it: {_HOW_TO_CALIBRATE}")
    antenna = _antenna(path, content.get("antenna_imu_m"))
    calibration = Calibration(np.eye(4) if T_imu_lidar is None else T_imu_lidar, T_camera_lidar, antenna)
    return calibration, LIDAR_MODELS[lidar] if lidar else None


def _matrix(path: Path, name: str, value: Any) -> Array | None:
    if value is None:
        return None
    try:
        matrix = np.array(value, dtype=np.float64)
    except (ValueError, TypeError):
        matrix = np.empty(0)
    if matrix.shape != (4, 4):
        raise DataError(f"{path}: {name} must be four rows of four numbers; {_HOW_TO_CALIBRATE}")
    return se3.check_pose(matrix, f"{path}: {name}")


def _antenna(path: Path, value: Any) -> Array | None:
    if value is None:
        return None
    try:
        antenna = np.array(value, dtype=np.float64)
    except (ValueError, TypeError):
        antenna = np.empty(0)
    if antenna.shape != (3,) or not np.isfinite(antenna).all():
        raise DataError(f"{path}: antenna_imu_m must be three finite numbers, the GPS antenna in the IMU's frame")
    return antenna
