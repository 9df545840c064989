"""KITTI raw data: a drive ``<date>/<date>_drive_NNNN_sync`` with its date's calibration, and what the simulator writes.

Beside the scans a drive may hold what the simulator adds: ``poses.txt`` (exact lidar poses, preferred as reference),
``simulation.json`` (sensor names and noise), ``gps.csv`` and per-point times in ``velodyne_points/offsets``.
KITTI's own scans are already motion-compensated and carry no times.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybridlio import se3
from hybridlio.datasets.extras import read_gps_csv, read_simulation
from hybridlio.datasets.kitti_files import BinScans, numbered, read_calibration, read_rigid, rows_of
from hybridlio.datasets.oxts import OxtsRows, read_oxts
from hybridlio.datasets.sequence import Notes, Sequence
from hybridlio.datasets.stamps import MISSING_STAMP, increasing, note_coverage, note_gaps, read_stamps
from hybridlio.errors import DataError
from hybridlio.sensors import LIDAR_MODELS, Calibration, ImuSamples
from hybridlio.trajectory import Trajectory
from hybridlio.trajectory_files import read_kitti

LAYOUT = "a drive folder with velodyne_points/data/NNNNNNNNNN.bin, or the date or root folder above it"

_SLOW_IMU = (
    "no 100 Hz inertial data: using the {rate:.0f} Hz rows of {folder}. That is about one sample a scan: what the car "
    "does between samples is interpolated and vibration is aliased into them, so motion predicted from them is less "
    "accurate. Put the drive's unsynchronised recording beside it, as {extract}, to use its 100 Hz"
)


def find(path: Path) -> dict[str, Path]:
    """The drives at or directly below ``path``: folder by name, such as ``2011_09_26_drive_0005``."""
    here = [path, *list(path.parents)[:2]]  # also from inside, as velodyne_points/data
    drives = [p for p in here if (p / "velodyne_points").is_dir()][:1]
    below = (p.parent for depth in ("*", "*/*") for p in path.glob(f"{depth}/velodyne_points"))
    drives = drives or sorted(d for d in below if not any(part.startswith(".") for part in d.relative_to(path).parts))
    return {d.resolve().name.removesuffix("_sync"): d for d in drives if not d.name.endswith("_extract")}


def open_drive(drive: Path, raw_root: Path | None = None) -> Sequence:
    """One drive. ``raw_root`` is not needed here: calibration and 100 Hz data lie beside the drive.

    Stamps are the scans' own, or else those of the navigation rows with the same numbers. The inertial samples are
    the 100 Hz ones of the sibling ``*_extract`` folder where it exists, else the 10 Hz ones, with a warning. Angular
    rates that are late against the attitudes, as KITTI's are, move to when they were, with a note
    (:func:`hybridlio.datasets.gyro_lag.gyro_lag_ns`).

    Raises:
        DataError: no scans, stamps that do not match them, malformed navigation rows, or a missing calibration.
    """
    del raw_root
    drive = drive.resolve()
    notes = Notes(drive.name.removesuffix("_sync"))
    numbers, stamps, paths = _scans(drive, notes)
    offsets = drive / "velodyne_points/offsets"
    oxts = read_oxts(drive / "oxts", notes) if (drive / "oxts").is_dir() else None
    calibration = read_drive_calibration(drive.parent, needs_imu=oxts is not None)
    simulation = read_simulation(drive / "simulation.json")
    imu = drive_imu(drive, oxts, notes)
    note_coverage(imu.stamps_ns, stamps, "inertial data", notes)
    return Sequence(
        name=notes.name,
        stamps_ns=stamps,
        load_scan=BinScans(paths, stamps, offsets if offsets.is_dir() else None),
        imu=imu,
        calibration=calibration,
        reference=_reference(drive, numbers, stamps, oxts, calibration, notes),
        gps=read_gps_csv(drive / "gps.csv"),
        lidar=simulation.lidar if simulation else LIDAR_MODELS["hdl-64e"],
        forward_speed_m_s=oxts.forward_speed_at(stamps) if oxts else None,
        imu_noise=simulation.imu_noise if simulation else None,
        notes=tuple(notes.texts),
    )


def scan_stamps(drive: Path, notes: Notes) -> NDArray[np.int64]:
    """Stamps by scan number: the scans' own or, where KITTI has none, those of the navigation rows.

    Raises:
        DataError: the drive has neither.
    """
    own, rows = drive / "velodyne_points/timestamps.txt", drive / "oxts/timestamps.txt"
    if own.is_file():
        return read_stamps(own)
    if not rows.is_file():
        raise DataError(f"{own}: no such file, and no {rows} to use instead; the scans have no stamps")
    notes.add(f"no {own.name} in velodyne_points: scans get the stamps of the navigation rows with their numbers")
    return read_stamps(rows)


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
    keep = increasing(lines[numbers])
    if len(keep) < len(numbers):
        dropped = np.setdiff1d(numbers, numbers[keep])
        notes.add(f"dropped {len(dropped)} scans whose stamps repeat or go backwards, first number {dropped[0]}")
    numbers = numbers[keep]
    note_gaps(lines[numbers], "scans", notes, factor=1.5)
    return numbers, lines[numbers], tuple(paths[k] for k in keep)


def drive_imu(drive: Path, oxts: OxtsRows | None, notes: Notes) -> ImuSamples:
    """The inertial samples of a drive: 100 Hz from the sibling ``*_extract`` folder, else those of ``oxts``."""
    extract = drive.with_name(drive.name.removesuffix("_sync") + "_extract")
    if (extract / "oxts").is_dir():
        return _in_time(read_oxts(extract / "oxts", notes), notes)
    if oxts is None:
        notes.add(f"no inertial data: neither {drive / 'oxts'} nor {extract / 'oxts'} exists")
        return ImuSamples.empty()
    rate = 1e9 / float(np.median(np.diff(oxts.stamps_ns))) if len(oxts) > 1 else 0.0
    if rate < 50:
        notes.add(_SLOW_IMU.format(rate=rate, folder=drive / "oxts", extract=extract.name))
    return _in_time(oxts, notes)


def _in_time(rows: OxtsRows, notes: Notes) -> ImuSamples:
    lag_ns = rows.gyro_lag_ns
    if lag_ns:
        notes.add(f"angular rates are {lag_ns / 1e6:.0f} ms late against the attitudes of the same rows; moved back")
    return rows.imu(lag_ns)


def read_drive_calibration(date: Path, needs_imu: bool) -> Calibration:
    """Extrinsics from a date folder; the camera is the rectified one where ``calib_cam_to_cam.txt`` is there too.

    Raises:
        DataError: ``calib_imu_to_velo.txt`` is missing although the drive has inertial data, or a file is malformed.
    """
    imu_to_velo, velo_to_cam = date / "calib_imu_to_velo.txt", date / "calib_velo_to_cam.txt"
    T_imu_lidar = se3.inverse(read_rigid(imu_to_velo)) if needs_imu or imu_to_velo.is_file() else np.eye(4)
    T_camera_lidar = read_rigid(velo_to_cam) if velo_to_cam.is_file() else None
    cam_to_cam = date / "calib_cam_to_cam.txt"
    if T_camera_lidar is not None and cam_to_cam.is_file():
        (R_rect,) = rows_of(read_calibration(cam_to_cam), cam_to_cam, "R_rect_00")
        T_camera_lidar = se3.make(R_rect, np.zeros(3)) @ T_camera_lidar
    return Calibration(T_imu_lidar, T_camera_lidar)


def _reference(
    drive: Path,
    numbers: NDArray[np.int64],
    stamps: NDArray[np.int64],
    oxts: OxtsRows | None,
    calibration: Calibration,
    notes: Notes,
) -> Trajectory | None:
    """Exact poses where the drive holds them, else from the navigation rows."""
    exact = drive / "poses.txt"
    if exact.is_file():
        poses = read_kitti(exact).poses
        if len(poses) <= numbers[-1]:
            raise DataError(f"{exact}: {len(poses)} poses do not reach scan number {numbers[-1]}")
        return Trajectory(stamps, poses[numbers]).from_first()
    return oxts.lidar_poses_at(stamps, calibration.T_imu_lidar, notes) if oxts else None
