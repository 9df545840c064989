"""KITTI odometry: ``sequences/NN`` with poses in the left camera's frame; inertial data joined from the raw drives."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybridlio.core import se3
from hybridlio.core.errors import DataError
from hybridlio.core.sensors import LIDAR_MODELS, Calibration, ImuSamples
from hybridlio.core.trajectory import Trajectory
from hybridlio.core.trajectory_files import read_kitti
from hybridlio.datasets.drive_imu import drive_imu
from hybridlio.datasets.kitti_files import BinScans, numbered, read_calibration, rows_of
from hybridlio.datasets.kitti_raw import read_drive_calibration
from hybridlio.datasets.oxts import read_oxts
from hybridlio.datasets.sequence import Notes, Sequence
from hybridlio.datasets.stamps import note_coverage, note_gaps, read_stamps, usable_scans
from hybridlio.datasets.vertical_angle import kitti_raised

LAYOUT = (
    "a sequence folder with velodyne/NNNNNN.bin and times.txt, or the folder above it, or its sequences/ beside poses/"
)


@dataclass(frozen=True)
class RawDrive:
    """The raw drive that a sequence was cut from, and the number of its first and last frame there."""

    name: str
    first: int
    last: int


RAW_DRIVES: dict[str, RawDrive] = {  # as the devkit of the odometry benchmark lists them; 03's drive has no raw data
    "00": RawDrive("2011_10_03_drive_0027", 0, 4540),
    "01": RawDrive("2011_10_03_drive_0042", 0, 1100),
    "02": RawDrive("2011_10_03_drive_0034", 0, 4660),
    "04": RawDrive("2011_09_30_drive_0016", 0, 270),
    "05": RawDrive("2011_09_30_drive_0018", 0, 2760),
    "06": RawDrive("2011_09_30_drive_0020", 0, 1100),
    "07": RawDrive("2011_09_30_drive_0027", 0, 1100),
    "08": RawDrive("2011_09_30_drive_0028", 1100, 5170),
    "09": RawDrive("2011_09_30_drive_0033", 0, 1590),
    "10": RawDrive("2011_09_30_drive_0034", 0, 1200),
}


def _is_sequence(path: Path) -> bool:
    return (path / "velodyne").is_dir() and (path / "times.txt").is_file()


def find(path: Path) -> dict[str, Path]:
    """The sequences at or below ``path``: folder by name, such as ``00``."""
    here = [p for p in (path, path.parent) if _is_sequence(p)][:1]
    below = (p for pattern in ("*", "sequences/*", "dataset/sequences/*") for p in path.glob(pattern))
    return {p.resolve().name: p for p in here or sorted(filter(_is_sequence, below))}


def open_sequence_folder(
    folder: Path, raw_root: Path | None = None, vertical_angle_deg: float | None = None
) -> Sequence:
    """One sequence: the scans on disk with their stamps (seconds from the recording's first frame) and references.

    With ``raw_root`` (the folder of the date folders) the inertial samples and ``T_imu_lidar`` come from the raw drive
    that the sequence was cut from, moved to the sequence's clock; without it there are none and ``T_imu_lidar`` is the
    identity. Points are raised by ``vertical_angle_deg``, without it by KITTI's known error where the sequence is
    KITTI's own (:mod:`hybridlio.datasets.vertical_angle`).

    Raises:
        DataError: no scans, stamps or poses that do not match them, a missing calibration, or no such raw drive.
        ConfigError: ``vertical_angle_deg`` is over 5°.
    """
    folder = folder.resolve()
    notes = Notes(f"kitti_{folder.name}")
    numbers, times, paths = _scans(folder, notes)
    stamps = times[numbers]
    (Tr,) = rows_of(read_calibration(folder / "calib.txt"), folder / "calib.txt", "Tr")
    T_camera_lidar = _camera(folder / "calib.txt", Tr)
    imu, T_imu_lidar = _imu(folder.name, times, raw_root, notes)
    note_coverage(imu.stamps_ns, stamps, "inertial data", notes)
    return Sequence(
        name=notes.name,
        stamps_ns=stamps,
        load_scan=kitti_raised(BinScans(paths, stamps), len(paths), Tr, vertical_angle_deg, notes),
        imu=imu,
        calibration=Calibration(T_imu_lidar, T_camera_lidar),
        reference=_reference(folder, numbers, stamps, T_camera_lidar, notes),
        lidar=LIDAR_MODELS["hdl-64e"],
        pose_file_frame="camera",
        notes=tuple(notes.texts),
    )


def _scans(folder: Path, notes: Notes) -> tuple[NDArray[np.int64], NDArray[np.int64], tuple[Path, ...]]:
    """Numbers of the scans present, the stamps of all frames, and the scans' files."""
    numbers, paths = numbered(folder / "velodyne", ".bin")
    if not len(numbers):
        raise DataError(f"{folder / 'velodyne'}: no scans NNNNNN.bin")
    times = read_stamps(folder / "times.txt")
    if numbers[-1] >= len(times):
        raise DataError(f"{folder / 'times.txt'}: {len(times)} stamps do not reach scan {paths[-1].name}")
    if len(usable_scans(times[numbers], folder / "times.txt")) < len(numbers):
        raise DataError(f"{folder / 'times.txt'}: stamps of the scans do not increase; download the file again")
    if len(numbers) < len(times):
        notes.add(f"{len(numbers)} of {len(times)} scans are on disk; using those, with their stamps and references")
    note_gaps(times[numbers], "scans", notes, factor=1.5)
    return numbers, times, paths


def _camera(path: Path, Tr: NDArray[np.float64]) -> NDArray[np.float64]:
    if Tr.shape != (3, 4):
        raise DataError(f"{path}: expected 12 numbers in 'Tr:', found {Tr.size}")
    return se3.check_pose(np.vstack([Tr, [0, 0, 0, 1]]), f"{path}: Tr")


def _reference(
    folder: Path,
    numbers: NDArray[np.int64],
    stamps: NDArray[np.int64],
    T_camera_lidar: NDArray[np.float64],
    notes: Notes,
) -> Trajectory | None:
    """The benchmark's poses, of the camera, as lidar poses in the first scan's frame."""
    path = folder.parent.parent / "poses" / f"{folder.name}.txt"
    if not path.is_file():
        notes.add(f"no reference poses: {path} does not exist")
        return None
    poses = read_kitti(path, T_camera_lidar=T_camera_lidar).poses
    if len(poses) <= numbers[-1]:
        raise DataError(f"{path}: {len(poses)} poses do not reach scan number {numbers[-1]}")
    return Trajectory(stamps, poses[numbers]).from_first()


def _imu(
    name: str, times: NDArray[np.int64], raw_root: Path | None, notes: Notes
) -> tuple[ImuSamples, NDArray[np.float64]]:
    """Inertial samples on the sequence's clock, with ``T_imu_lidar``; none without a raw root or a raw drive."""
    if raw_root is None or name not in RAW_DRIVES:
        why = "give a raw root to join it" if raw_root is None else "the sequence has no published raw drive"
        notes.add(f"no inertial data: {why}")
        return ImuSamples.empty(), np.eye(4)
    raw = RAW_DRIVES[name]
    drive = raw_root / raw.name[:10] / f"{raw.name}_sync"
    if not (drive / "oxts").is_dir():
        raise DataError(
            f"{drive / 'oxts'}: no such folder; sequence {name} was cut from that raw drive, unpack it there"
        )
    imu = drive_imu(drive, read_oxts(drive / "oxts", notes), notes)
    shift_ns = _clock_start_ns(drive, raw, notes) - int(times[0])
    moved = ImuSamples(imu.stamps_ns - shift_ns, imu.gyro_rad_s, imu.accel_m_s2)
    return moved, read_drive_calibration(drive, needs_imu=True).T_imu_lidar


def _clock_start_ns(drive: Path, raw: RawDrive, notes: Notes) -> int:
    """When the sequence's clock started: its times are those of the left camera, which triggers the navigation row."""
    camera, rows = drive / "image_00/timestamps.txt", drive / "oxts/timestamps.txt"
    stamps = read_stamps(camera if camera.is_file() else rows)
    if raw.last >= len(stamps):
        notes.add(
            f"{drive.name} has {len(stamps)} frames, fewer than the {raw.last + 1} that the sequence was cut from"
        )
    if raw.first >= len(stamps):
        raise DataError(f"{drive}: {len(stamps)} stamps do not reach frame {raw.first}, where the sequence starts")
    return int(stamps[raw.first])
