"""KITTI raw data: a drive ``<date>/<date>_drive_NNNN_sync`` with its date's calibration, and what the simulator writes.

Beside the scans a drive may hold what the simulator adds: ``poses.txt`` (exact lidar poses, preferred as reference),
``simulation.json`` (sensor names and noise), ``gps.csv`` and per-point times in ``velodyne_points/offsets``.
KITTI's own scans carry no times.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybridlio.core import se3
from hybridlio.core.errors import DataError
from hybridlio.core.sensors import LIDAR_MODELS, Calibration
from hybridlio.core.trajectory import Trajectory
from hybridlio.core.trajectory_files import read_kitti
from hybridlio.datasets.drive_imu import drive_imu, fast_rows
from hybridlio.datasets.extras import note_fixes, read_gps_csv, read_simulation
from hybridlio.datasets.kitti_files import BinScans, numbered, read_calibration, read_rigid, rows_of
from hybridlio.datasets.oxts import OxtsRows, read_oxts
from hybridlio.datasets.sequence import Notes, Sequence
from hybridlio.datasets.stamps import MISSING_STAMP, note_coverage, note_gaps, read_stamps, usable_scans
from hybridlio.datasets.vertical_angle import kitti_raised

LAYOUT = "a drive folder with velodyne_points/data/NNNNNNNNNN.bin, or the date or root folder above it"

_LEAST_ROW_STEP_NS = 30_000_000


def find(path: Path) -> dict[str, Path]:
    """The drives at or directly below ``path``: folder by name, such as ``2011_09_26_drive_0005``."""
    here = [path, *list(path.parents)[:2]]  # also from inside, as velodyne_points/data
    drives = [p for p in here if (p / "velodyne_points").is_dir()][:1]
    below = (p.parent for depth in ("*", "*/*") for p in path.glob(f"{depth}/velodyne_points"))
    drives = drives or sorted(d for d in below if not any(part.startswith(".") for part in d.relative_to(path).parts))
    return {d.resolve().name.removesuffix("_sync"): d for d in drives if not d.name.endswith("_extract")}


def open_drive(drive: Path, raw_root: Path | None = None, vertical_angle_deg: float | None = None) -> Sequence:
    """One drive. ``raw_root`` is not needed here: calibration and 100 Hz data lie beside the drive.

    Stamps are the scans' own, or else those of the navigation rows with the same numbers. The inertial samples are
    the 100 Hz ones of the sibling ``*_extract`` folder where it exists, else the 10 Hz ones, with a warning; see
    :func:`hybridlio.datasets.drive_imu.drive_imu`. Points are raised by ``vertical_angle_deg``, without it by KITTI's
    known error where the drive is KITTI's own (:mod:`hybridlio.datasets.vertical_angle`).

    Raises:
        DataError: no scans, stamps that do not match them, malformed navigation rows, or a missing calibration.
        ConfigError: ``vertical_angle_deg`` is over 5°.
    """
    del raw_root
    drive = drive.resolve()
    notes = Notes(drive.name.removesuffix("_sync"))
    numbers, stamps, paths = _scans(drive, notes)
    offsets = drive / "velodyne_points/offsets"
    scans = BinScans(paths, stamps, offsets if offsets.is_dir() else None)
    oxts = read_oxts(drive / "oxts", notes) if (drive / "oxts").is_dir() else None
    calibration = read_drive_calibration(drive, needs_imu=oxts is not None or fast_rows(drive).is_dir())
    simulation = read_simulation(drive / "simulation.json")
    imu = drive_imu(drive, oxts, notes)
    note_coverage(imu.stamps_ns, stamps, "inertial data", notes)
    gps = read_gps_csv(drive / "gps.csv")
    note_fixes(gps, stamps, notes)
    return Sequence(
        name=notes.name,
        stamps_ns=stamps,
        load_scan=kitti_raised(scans, len(paths), _imu_to_velo(drive), vertical_angle_deg, notes),
        imu=imu,
        calibration=calibration,
        reference=_reference(drive, numbers, stamps, oxts, calibration, notes),
        gps=gps,
        lidar=simulation.lidar if simulation else LIDAR_MODELS["hdl-64e"],
        forward_speed_m_s=oxts.forward_speed_at(stamps) if oxts else None,
        imu_noise=simulation.imu_noise if simulation else None,
        notes=tuple(notes.texts),
    )


def scan_stamps(drive: Path, notes: Notes) -> NDArray[np.int64]:
    """Stamps by scan number: the scans' own or, where KITTI has none, those of the navigation rows.

    Raises:
        DataError: the drive has neither, or rows too close in time to be one a scan.
    """
    own, rows = drive / "velodyne_points/timestamps.txt", drive / "oxts/timestamps.txt"
    if own.is_file():
        return read_stamps(own)
    if not rows.is_file():
        raise DataError(f"{own}: no such file, and no {rows} to use instead; the scans have no stamps")
    stamps = read_stamps(rows)
    if len(stamps) > 1 and np.median(np.diff(stamps)) < _LEAST_ROW_STEP_NS:
        raise DataError(f"{own}: no such file, and the rows of {rows} are too many to be one a scan; write the scans'")
    notes.add(f"no {own.name} in velodyne_points: scans get the stamps of the navigation rows with their numbers")
    return stamps


def _scans(drive: Path, notes: Notes) -> tuple[NDArray[np.int64], NDArray[np.int64], tuple[Path, ...]]:
    """Numbers, stamps and files of the scans to use: those present, with stamps that increase."""
    folder = drive / "velodyne_points/data"
    numbers, paths = numbered(folder, ".bin")
    if not len(numbers):
        raise DataError(f"{folder}: no scans NNNNNNNNNN.bin")
    lines = scan_stamps(drive, notes)
    if numbers[-1] >= len(lines) or (lines[numbers] == MISSING_STAMP).any():
        raise DataError(f"{drive}: {len(lines)} lines of stamps do not cover every scan up to {paths[-1].name}")
    missing = int(numbers[-1] - numbers[0] + 1 - len(numbers))
    if missing:
        first = int(np.setdiff1d(np.arange(numbers[0], numbers[-1]), numbers)[0])
        notes.add(f"{missing} scans are missing in {folder}, the first is number {first}; motion there is bridged")
    keep = usable_scans(lines[numbers], drive / "velodyne_points/timestamps.txt")
    if len(keep) < len(numbers):
        dropped = np.setdiff1d(numbers, numbers[keep])
        notes.add(f"dropped {len(dropped)} scans whose stamps repeat or go backwards, first number {dropped[0]}")
    numbers = numbers[keep]
    note_gaps(lines[numbers], "scans", notes, factor=1.5)
    return numbers, lines[numbers], tuple(paths[k] for k in keep)


def read_drive_calibration(drive: Path, needs_imu: bool) -> Calibration:
    """Extrinsics from the drive's date folder, or the drive's own; the camera is the rectified one where known.

    Only ``calib_imu_to_velo.txt`` is needed, and only with inertial data. ``calib_velo_to_cam.txt``, and
    ``calib_cam_to_cam.txt`` for the rectification, are read where they are there.

    Raises:
        DataError: ``calib_imu_to_velo.txt`` is missing although the drive has inertial data, or a file is malformed.
    """
    imu_to_velo, velo_to_cam, cam_to_cam = (
        _calibration_file(drive, f"calib_{name}.txt") for name in ("imu_to_velo", "velo_to_cam", "cam_to_cam")
    )
    if needs_imu and not imu_to_velo.is_file():
        raise DataError(
            f"{imu_to_velo}: missing calibration, which inertial data needs; download it, or write where the sensors "
            "are: rows 'R:' with 9 numbers and 'T:' with 3, which map IMU points into the lidar frame"
        )
    T_imu_lidar = se3.inverse(read_rigid(imu_to_velo)) if imu_to_velo.is_file() else np.eye(4)
    T_camera_lidar = read_rigid(velo_to_cam) if velo_to_cam.is_file() else None
    if T_camera_lidar is not None and cam_to_cam.is_file():
        (R_rect,) = rows_of(read_calibration(cam_to_cam), cam_to_cam, "R_rect_00")
        T_camera_lidar = se3.make(R_rect, np.zeros(3)) @ T_camera_lidar
    return Calibration(T_imu_lidar, T_camera_lidar)


def _calibration_file(drive: Path, name: str) -> Path:
    own = drive / name
    return own if own.is_file() else drive.parent / name


def _imu_to_velo(drive: Path) -> NDArray[np.float64]:
    """The numbers of ``calib_imu_to_velo.txt`` as they stand there, none without it."""
    path = _calibration_file(drive, "calib_imu_to_velo.txt")
    if not path.is_file():
        return np.empty(0)
    return np.concatenate([row.ravel() for row in rows_of(read_calibration(path), path, "R", "T")])


def _reference(
    drive: Path,
    numbers: NDArray[np.int64],
    stamps: NDArray[np.int64],
    oxts: OxtsRows | None,
    calibration: Calibration,
    notes: Notes,
) -> Trajectory | None:
    """Exact poses where the drive holds them, or lie beside it as its date's only drive, else from navigation rows."""
    navigated = oxts.lidar_poses_at(stamps, calibration.T_imu_lidar, notes) if oxts else None
    exact = _exact_poses(drive)
    if exact is None:
        return navigated
    poses, on_disk = read_kitti(exact).poses, numbered(drive / "velodyne_points/data", ".bin")[0]
    if numbers[-1] < len(poses):
        rows = numbers
    elif len(poses) == len(on_disk):
        rows = np.searchsorted(on_disk, numbers)
    else:
        raise DataError(f"{exact}: {len(poses)} poses do not reach scan number {numbers[-1]}")
    reference = Trajectory(stamps, poses[rows]).from_first()
    if navigated is not None:
        _note_other_frame(exact, reference, navigated, notes)
    return reference


def _exact_poses(drive: Path) -> Path | None:
    own, beside = drive / "poses.txt", drive.parent / "poses.txt"
    if own.is_file():
        return own
    return beside if beside.is_file() and len(list(drive.parent.glob("*/velodyne_points/data"))) == 1 else None


def _note_other_frame(path: Path, poses: Trajectory, navigated: Trajectory, notes: Notes) -> None:
    """Say if the poses move in another direction than the navigation rows do, as those of a camera would."""
    there, here = (max(t.poses[:, :3, 3], key=lambda p: float(p @ p)) for t in (poses, navigated))
    lengths = float(np.linalg.norm(there)), float(np.linalg.norm(here))
    if min(lengths) > 5.0 and there @ here < 0.7 * lengths[0] * lengths[1]:
        notes.add(f"{path} moves in another direction than the navigation rows; it must hold poses of the lidar")
