"""Reader of plain folders: scans in natural order, a file of stamps, an IMU CSV and a calibration.

recording/
    scans/*                      of one kind, see `points.point_files`; also in lidar/, points/, velodyne/, data/,
                                 or directly in recording/
    timestamps.txt or times.txt  one stamp per scan, see `stamps.read_stamps`
    imu.csv                      optional, see `imu_csv`; also imu0/data.csv and mav0/imu0/data.csv, as of EuRoC
    calibration.yaml             needed with an IMU, see `calibration_yaml`
    poses_tum.txt                optional reference: lidar poses on the scans' clock, TUM format
    gps.csv                      optional, see `gps_csv`
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from hybridlio.core.arrays import Stamps
from hybridlio.core.errors import DataError
from hybridlio.core.sensors import NS_PER_S, ImuSamples
from hybridlio.core.trajectory import read_tum
from hybridlio.datasets.calibration_yaml import read_calibration_yaml
from hybridlio.datasets.gps_csv import note_fixes, read_gps_csv
from hybridlio.datasets.imu_csv import read_imu_csv
from hybridlio.datasets.imu_mounting import note_mounting, on_scans_clock
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

LAYOUT = f"a folder with timestamps.txt, and scans in it or in scans/ ({', '.join(SUFFIXES)})"

_SCAN_FOLDERS = ("scans", "lidar", "points", "velodyne", "data", ".")  # the folder itself last: a map may be in it
_IMU_FILES = ("imu.csv", "imu0/data.csv", "mav0/imu0/data.csv")  # the latter as EuRoC and TUM-VI name them
_STAMP_FILES = ("timestamps.txt", "times.txt")


def find(path: Path) -> dict[str, Path]:
    """Find the recording at ``path``, or those in the folders directly below: folders by name."""
    here = [path] if _scan_files(path) else sorted(p for p in path.glob("*") if _stamp_files(p) and _scan_files(p))
    return {p.resolve().name: p for p in here}


def is_recording(folder: Path) -> bool:
    """Return whether the folder itself is a recording: it has a file of stamps, and scans."""
    return bool(_stamp_files(folder) and _scan_files(folder))


def open_folder(
    folder: Path,
    raw_root: Path | None = None,
    vertical_angle_deg: float | None = None,
    rate_hz: float | None = None,
) -> Sequence:
    """Open one recording in the layout above.

    Args:
        folder: the recording's folder.
        raw_root: not used.
        vertical_angle_deg: angle by which points are raised; none by default.
        rate_hz: scans per second, if there is no file of stamps; ``rate_hz`` of ``calibration.yaml`` by default.

    Raises:
        DataError: stamps are missing or not one per scan, ``imu.csv`` has no ``T_imu_lidar``, or a file is malformed;
            the message says what to write.
        ConfigError: ``vertical_angle_deg`` is over 5°.
    """
    del raw_root
    folder = folder.resolve()
    notes = Notes(folder.name)
    imu_file = next((folder / name for name in _IMU_FILES if (folder / name).is_file()), None)
    imu = read_imu_csv(imu_file, notes) if imu_file else ImuSamples.empty()
    stated = read_calibration_yaml(folder / "calibration.yaml", needs_imu=len(imu) > 0)
    stamps, paths = _stamped(folder, _scan_files(folder), stated.rate_hz if rate_hz is None else rate_hz, notes)
    if len(imu):
        imu = on_scans_clock(imu, stated.imu_time_offset_s, notes)
        note_mounting(imu, stated.calibration.T_imu_lidar, notes)
    else:
        notes.add(f"no inertial data: {folder / 'imu.csv'} does not exist")
    note_coverage(imu.stamps_ns, stamps, "inertial data", notes)
    gps = read_gps_csv(folder / "gps.csv")
    note_fixes(gps, stamps, notes)
    poses = read_tum(folder / "poses_tum.txt") if (folder / "poses_tum.txt").is_file() else None
    return Sequence(
        name=folder.name,
        stamps_ns=stamps,
        load_scan=raised(open_point_files(paths, stamps, notes, stated.layout, stated.format), vertical_angle_deg),
        imu=imu,
        calibration=stated.calibration,
        reference=poses_at(stamps, poses.stamps_ns, poses.poses, "rows of poses_tum.txt", notes) if poses else None,
        gps=gps,
        lidar=stated.lidar,
        imu_noise=stated.imu_noise,
        imu_time_offset_s=stated.imu_time_offset_s,
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


def _stamped(
    folder: Path, paths: tuple[Path, ...], rate_hz: float | None, notes: Notes
) -> tuple[Stamps, tuple[Path, ...]]:
    """Return stamps and files of the scans, without those whose stamps do not increase."""
    if not paths:
        raise DataError(f"{folder}: no scans ({', '.join(SUFFIXES)})")
    suffixes = sorted({p.suffix for p in paths})
    if len(suffixes) > 1:
        raise DataError(f"{paths[0].parent}: scans of several kinds ({', '.join(suffixes)}); keep one kind per folder")
    files = _stamp_files(folder)
    if not files and rate_hz is not None:
        notes.add(
            f"no {' or '.join(_STAMP_FILES)}: scans are taken to be evenly spaced, {rate_hz:g} a second, from 0 s"
        )
        return np.round(np.arange(len(paths)) * (NS_PER_S / rate_hz)).astype(np.int64), paths
    if not files:
        raise DataError(
            f"{folder}: no {' or '.join(_STAMP_FILES)}; write one stamp per line, in seconds, for each scan, or for "
            "scans at a constant rate give --rate 10 ('rate_hz: 10' in calibration.yaml)"
        )
    stamps = read_stamps(files[0])
    if len(stamps) != len(paths) or (stamps == MISSING_STAMP).any():
        raise DataError(f"{files[0]}: {len(stamps)} lines for {len(paths)} scans; each scan needs one stamp")
    keep = usable_scans(stamps, files[0])
    if len(keep) < len(paths):
        first = paths[int(np.setdiff1d(np.arange(len(paths)), keep)[0])].name
        notes.corrected(f"dropped {len(paths) - len(keep)} scans whose stamps repeat or go backwards, first {first}")
    note_gaps(stamps[keep], "scans", notes, SCAN_GAP_FACTOR)
    return stamps[keep], tuple(paths[k] for k in keep)
