"""Reader of KITTI raw data: a drive ``<date>/<date>_drive_NNNN_sync`` with the calibration in its date's folder.

    <date>/
        calib_imu_to_velo.txt                      needed with inertial data
        calib_velo_to_cam.txt calib_cam_to_cam.txt optional
        <date>_drive_NNNN_sync/
            velodyne_points/data/NNNNNNNNNN.bin    scans: float32 x y z reflectance, lidar frame
            velodyne_points/timestamps.txt         stamps of the scans; without it, those of the navigation rows
            oxts/data/NNNNNNNNNN.txt               optional: navigation rows, about 10 Hz
            oxts/timestamps.txt
        <date>_drive_NNNN_extract/oxts/            optional: navigation rows at 100 Hz

The simulator adds ``poses.txt`` (exact lidar poses, preferred as reference), ``simulation.json`` (lidar and IMU noise),
``gps.csv`` and ``velodyne_points/offsets/NNNNNNNNNN.npy`` (time of each point relative to the scan's stamp, int64 ns).
The scans of KITTI itself have no point times.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hybridlio.core.arrays import Array, Index, Stamps
from hybridlio.core.errors import DataError
from hybridlio.core.sensors import Calibration
from hybridlio.core.trajectory import Trajectory, read_kitti
from hybridlio.datasets.gps_csv import note_fixes, read_gps_csv
from hybridlio.datasets.kitti.drive_imu import drive_imu, fast_rows
from hybridlio.datasets.kitti.files import (
    KITTI_LIDAR,
    BinScans,
    calibration_file,
    numbered,
    read_calibration,
    read_drive_calibration,
    read_simulation,
    rows_of,
)
from hybridlio.datasets.kitti.oxts import OxtsRows, read_oxts
from hybridlio.datasets.kitti.vertical_angle import kitti_raised
from hybridlio.datasets.notes import Notes
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

LAYOUT = "a drive folder with velodyne_points/data/NNNNNNNNNN.bin, or the date or root folder above it"

_MIN_ROW_STEP_NS = 30_000_000  # rows closer in time come from the 100 Hz recording, not one per scan
_MIN_COMPARED_M = 5.0  # directions of paths that leave the start by less are not compared
_MIN_COSINE = 0.7  # of the angle between paths: 45°; the axes of a camera frame are 90° off


def find(path: Path) -> dict[str, Path]:
    """Find the drives at, directly below or above ``path``: folders by name, such as ``2011_09_26_drive_0005``."""
    here = [path, *list(path.parents)[:2]]  # a path inside a drive, such as velodyne_points/data, works too
    drives = [p for p in here if (p / "velodyne_points").is_dir()][:1]
    below = (p.parent for depth in ("*", "*/*") for p in path.glob(f"{depth}/velodyne_points"))
    drives = drives or sorted(d for d in below if not any(part.startswith(".") for part in d.relative_to(path).parts))
    return {d.resolve().name.removesuffix("_sync"): d for d in drives if not d.name.endswith("_extract")}


def open_drive(drive: Path, raw_root: Path | None = None, vertical_angle_deg: float | None = None) -> Sequence:
    """Open one drive.

    The scans' stamps are their own, or those of the navigation rows with the same numbers. IMU samples are the 100 Hz
    ones of the sibling ``*_extract`` folder if it exists, else the 10 Hz ones, with a note
    (:func:`hybridlio.datasets.kitti.drive_imu.drive_imu`).

    Args:
        drive: the drive's folder.
        raw_root: not used, because calibration and 100 Hz data are beside the drive.
        vertical_angle_deg: angle by which points are raised; by default KITTI's known error if the drive is KITTI's
            own, else 0 (:mod:`hybridlio.datasets.kitti.vertical_angle`).

    Raises:
        DataError: no scans, scans without stamps, malformed navigation rows, or a missing calibration.
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
    gps = read_gps_csv(drive / "gps.csv", notes)
    note_fixes(gps, stamps, notes)
    return Sequence(
        name=notes.name,
        stamps_ns=stamps,
        load_scan=kitti_raised(scans, len(paths), _imu_to_velo(drive), vertical_angle_deg, notes),
        imu=imu,
        calibration=calibration,
        reference=_reference(drive, numbers, stamps, _navigated(oxts, stamps, calibration, notes), notes),
        gps=gps,
        lidar=simulation.lidar if simulation else KITTI_LIDAR,
        forward_speed_m_s=oxts.forward_speed_at(stamps) if oxts else None,
        imu_noise=simulation.imu_noise if simulation else None,
        notes=tuple(notes.texts),
    )


def _stamp_lines(drive: Path, notes: Notes) -> Stamps:
    """Return the stamps by scan number: the scans' own, or those of the navigation rows.

    Raises:
        DataError: the drive has neither, or its rows are too close in time to be one per scan.
    """
    own, rows = drive / "velodyne_points/timestamps.txt", drive / "oxts/timestamps.txt"
    if own.is_file():
        return read_stamps(own)
    if not rows.is_file():
        raise DataError(f"{own}: no such file, and no {rows} to use instead; write one stamp per scan")
    stamps = read_stamps(rows)
    if len(stamps) > 1 and np.median(np.diff(stamps)) < _MIN_ROW_STEP_NS:
        raise DataError(
            f"{own}: no such file, and {rows} has more than one row per scan; write one stamp per scan to the former"
        )
    notes.add(f"no {own.name} in velodyne_points: scans get the stamps of the navigation rows with the same numbers")
    return stamps


def _scans(drive: Path, notes: Notes) -> tuple[Index, Stamps, tuple[Path, ...]]:
    """Return numbers, stamps and files of the scans that exist, without those whose stamps do not increase."""
    folder = drive / "velodyne_points/data"
    numbers, paths = numbered(folder, ".bin")
    if not len(numbers):
        raise DataError(f"{folder}: no scans NNNNNNNNNN.bin")
    lines = _stamp_lines(drive, notes)
    if numbers[-1] >= len(lines) or (lines[numbers] == MISSING_STAMP).any():
        raise DataError(f"{drive}: {len(lines)} lines of stamps do not cover every scan up to {paths[-1].name}")
    missing = int(numbers[-1] - numbers[0] + 1 - len(numbers))
    if missing:
        first = int(np.setdiff1d(np.arange(numbers[0], numbers[-1]), numbers)[0])
        notes.add(f"{missing} scans are missing in {folder}, the first is number {first}; their motion is bridged")
    keep = usable_scans(lines[numbers], drive / "velodyne_points/timestamps.txt")
    if len(keep) < len(numbers):
        dropped = np.setdiff1d(numbers, numbers[keep])
        notes.corrected(f"dropped {len(dropped)} scans whose stamps repeat or go backwards, first number {dropped[0]}")
    numbers = numbers[keep]
    note_gaps(lines[numbers], "scans", notes, SCAN_GAP_FACTOR)
    return numbers, lines[numbers], tuple(paths[k] for k in keep)


def _imu_to_velo(drive: Path) -> Array:
    """Return the 12 numbers of ``calib_imu_to_velo.txt`` as written; none without the file."""
    path = calibration_file(drive, "calib_imu_to_velo.txt")
    if not path.is_file():
        return np.empty(0)
    return np.concatenate([row.ravel() for row in rows_of(read_calibration(path), path, "R", "T")])


def _navigated(oxts: OxtsRows | None, stamps: Stamps, calibration: Calibration, notes: Notes) -> Trajectory | None:
    """Return lidar poses at the scans, in the first one's frame, from the navigation rows; None if they have none."""
    if oxts is None:
        return None
    rows = oxts.with_positions
    if rows is None:
        notes.add("no reference poses: the navigation rows have no positions")
        return None
    return poses_at(stamps, rows.stamps_ns, rows.T_enu_imu @ calibration.T_imu_lidar, "navigation rows", notes)


def _reference(
    drive: Path, numbers: Index, stamps: Stamps, navigated: Trajectory | None, notes: Notes
) -> Trajectory | None:
    """Return the exact poses if there is a ``poses.txt``, else those of the navigation rows."""
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
    """Return the drive's ``poses.txt``, or that of its date if the date has no other drive."""
    own, beside = drive / "poses.txt", drive.parent / "poses.txt"
    if own.is_file():
        return own
    return beside if beside.is_file() and len(list(drive.parent.glob("*/velodyne_points/data"))) == 1 else None


def _note_other_frame(path: Path, poses: Trajectory, navigated: Trajectory, notes: Notes) -> None:
    """Note if the poses move in another direction than the navigation rows, as poses of a camera would."""
    there, here = (max(t.poses[:, :3, 3], key=lambda p: float(p @ p)) for t in (poses, navigated))
    lengths = float(np.linalg.norm(there)), float(np.linalg.norm(here))
    if min(lengths) > _MIN_COMPARED_M and there @ here < _MIN_COSINE * lengths[0] * lengths[1]:
        notes.add(f"{path} moves in another direction than the navigation rows; it must hold poses of the lidar")
