"""Reader of KITTI odometry sequences, with inertial data joined from the raw drives.

sequences/NN/velodyne/NNNNNN.bin    scans: float32 x y z reflectance, lidar frame
sequences/NN/times.txt              one stamp per scan: seconds from the first frame
sequences/NN/calib.txt              the row Tr (12 numbers) maps lidar points into the left camera's frame
poses/NN.txt                        optional reference: T_world_camera, 12 numbers a row
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Index, Stamps
from hybridlio.core.errors import DataError
from hybridlio.core.sensors import Calibration, ImuSamples
from hybridlio.core.trajectory import Trajectory, read_kitti
from hybridlio.datasets.kitti.drive_imu import drive_imu
from hybridlio.datasets.kitti.files import (
    KITTI_LIDAR,
    BinScans,
    numbered,
    read_calibration,
    read_drive_calibration,
    rows_of,
)
from hybridlio.datasets.kitti.oxts import read_oxts
from hybridlio.datasets.kitti.vertical_angle import kitti_raised
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.sequence import Sequence
from hybridlio.datasets.stamps import SCAN_GAP_FACTOR, note_coverage, note_gaps, read_stamps, usable_scans

LAYOUT = (
    "a sequence folder with velodyne/NNNNNN.bin and times.txt, or the folder above it, or its sequences/ beside poses/"
)


@dataclass(frozen=True)
class RawDrive:
    """The raw drive that a sequence was cut from, and the numbers of its first and last frame in that drive."""

    name: str
    first: int
    last: int


# from the development kit of the odometry benchmark; the drive of 03 was not published
RAW_DRIVES: dict[str, RawDrive] = {
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


def is_sequence(path: Path) -> bool:
    """Return whether the folder itself is a sequence: it has ``velodyne/`` and ``times.txt``."""
    return (path / "velodyne").is_dir() and (path / "times.txt").is_file()


def find(path: Path) -> dict[str, Path]:
    """Find the sequences at, below or directly above ``path``: folders by name, such as ``00``."""
    here = [p for p in (path, path.parent) if is_sequence(p)][:1]
    below = (p for pattern in ("*", "sequences/*", "dataset/sequences/*") for p in path.glob(pattern))
    return {p.resolve().name: p for p in here or sorted(filter(is_sequence, below))}


def open_sequence_folder(
    folder: Path, raw_root: Path | None = None, vertical_angle_deg: float | None = None
) -> Sequence:
    """Open one sequence: the scans on disk, with their stamps and reference poses.

    Args:
        folder: the sequence's folder.
        raw_root: the folder that holds the raw data's date folders. IMU samples and ``T_imu_lidar`` then come from the
            raw drive that the sequence was cut from, shifted to the sequence's clock. Without it there are no samples,
            and ``T_imu_lidar`` is the identity.
        vertical_angle_deg: angle by which points are raised; by default KITTI's known error if the sequence is KITTI's
            own, else 0 (:mod:`hybridlio.datasets.kitti.vertical_angle`).

    Raises:
        DataError: no scans, too few stamps or poses, stamps that do not increase, a missing calibration, or a missing
            raw drive.
        ConfigError: ``vertical_angle_deg`` is over 5°.
    """
    folder = folder.resolve()
    notes = Notes(f"kitti_{folder.name}")
    numbers, times, paths = _scans(folder, notes)
    stamps = times[numbers]
    (Tr,) = rows_of(read_calibration(folder / "calib.txt"), folder / "calib.txt", "Tr")
    T_camera_lidar = _T_camera_lidar(folder / "calib.txt", Tr)
    imu, T_imu_lidar = _imu(folder.name, times, raw_root, notes)
    note_coverage(imu.stamps_ns, stamps, "inertial data", notes)
    return Sequence(
        name=notes.name,
        stamps_ns=stamps,
        load_scan=kitti_raised(BinScans(paths, stamps), len(paths), Tr, vertical_angle_deg, notes),
        imu=imu,
        calibration=Calibration(T_imu_lidar, T_camera_lidar),
        reference=_reference(folder, numbers, stamps, T_camera_lidar, notes),
        lidar=KITTI_LIDAR,
        pose_file_frame="camera",
        notes=tuple(notes.texts),
    )


def _scans(folder: Path, notes: Notes) -> tuple[Index, Stamps, tuple[Path, ...]]:
    """Return the numbers of the scans on disk, the stamps of all frames, and the scans' files."""
    numbers, paths = numbered(folder / "velodyne", ".bin")
    if not len(numbers):
        raise DataError(f"{folder / 'velodyne'}: no scans NNNNNN.bin")
    times = read_stamps(folder / "times.txt")
    if numbers[-1] >= len(times):
        raise DataError(f"{folder / 'times.txt'}: {len(times)} stamps do not reach scan {paths[-1].name}")
    if len(usable_scans(times[numbers], folder / "times.txt")) < len(numbers):
        raise DataError(f"{folder / 'times.txt'}: the stamps of the scans do not increase; download the file again")
    if len(numbers) < len(times):
        notes.add(f"{len(numbers)} of {len(times)} scans are on disk; the others are left out")
    note_gaps(times[numbers], "scans", notes, SCAN_GAP_FACTOR)
    return numbers, times, paths


def _T_camera_lidar(path: Path, Tr: Array) -> Array:
    if Tr.shape != (3, 4):
        raise DataError(f"{path}: expected 12 numbers in 'Tr:', found {Tr.size}")
    return se3.check_pose(np.vstack([Tr, [0, 0, 0, 1]]), f"{path}: Tr")


def _reference(folder: Path, numbers: Index, stamps: Stamps, T_camera_lidar: Array, notes: Notes) -> Trajectory | None:
    """Return the benchmark's camera poses as lidar poses in the first scan's frame; None, with a note, if missing."""
    path = folder.parent.parent / "poses" / f"{folder.name}.txt"
    if not path.is_file():
        notes.add(f"no reference poses: {path} does not exist")
        return None
    poses = read_kitti(path, T_camera_lidar=T_camera_lidar).poses
    if len(poses) <= numbers[-1]:
        raise DataError(f"{path}: {len(poses)} poses do not reach scan number {numbers[-1]}")
    return Trajectory(stamps, poses[numbers]).from_first()


def _imu(name: str, times: Stamps, raw_root: Path | None, notes: Notes) -> tuple[ImuSamples, Array]:
    """Return IMU samples on the sequence's clock, and ``T_imu_lidar``; none without a raw root or a raw drive."""
    if raw_root is None or name not in RAW_DRIVES:
        why = (
            "give raw_root (--raw-root) to join them" if raw_root is None else "the sequence has no published raw drive"
        )
        notes.add(f"no inertial data: {why}")
        return ImuSamples.empty(), np.eye(4)
    raw = RAW_DRIVES[name]
    drive = raw_root / raw.name[:10] / f"{raw.name}_sync"
    if not (drive / "oxts").is_dir():
        raise DataError(
            f"{drive / 'oxts'}: no such folder; sequence {name} was cut from this raw drive: unpack it there"
        )
    imu = drive_imu(drive, read_oxts(drive / "oxts", notes), notes)
    shift_ns = _clock_start_ns(drive, raw, notes) - int(times[0])
    shifted = ImuSamples(imu.stamps_ns - shift_ns, imu.gyro_rad_s, imu.accel_m_s2)
    return shifted, read_drive_calibration(drive, needs_imu=True).T_imu_lidar


def _clock_start_ns(drive: Path, raw: RawDrive, notes: Notes) -> int:
    """Return the drive's stamp at the sequence's time 0.

    The sequence's times are those of the left camera. Without its stamps, those of the navigation rows, which are
    synchronised to the camera, are within some milliseconds.
    """
    camera, rows = drive / "image_00/timestamps.txt", drive / "oxts/timestamps.txt"
    stamps = read_stamps(camera if camera.is_file() else rows)
    if raw.last >= len(stamps):
        notes.add(f"{drive.name} has {len(stamps)} frames, but the sequence was cut from {raw.last + 1}")
    if raw.first >= len(stamps):
        raise DataError(f"{drive}: {len(stamps)} stamps do not reach frame {raw.first}, the sequence's first")
    return int(stamps[raw.first])
