"""Reader of plain folders: scans in natural order, a file of stamps, an IMU CSV and a calibration.

recording/
    scans/*                      of one kind, see `points.point_files`; also in lidar/, points/, velodyne/, data/,
                                 directly in recording/, or in a single subfolder of another name
    timestamps.txt or times.txt  one stamp per scan, see `stamps.read_stamps`; also beside the scans, or the names of
                                 their files are the stamps
    imu.csv                      optional, see `imu_csv`; also imu0/data.csv and mav0/imu0/data.csv, as of EuRoC
    calibration.yaml             needed with an IMU, see `calibration_yaml`
    poses_tum.txt                optional reference: lidar poses on the scans' clock, TUM format
    gps.csv                      optional, see `gps_csv`
    NAME/*                       optional: scans of a further lidar, if `calibration.yaml` gives its pose in `lidars`;
                                 with a file of stamps of its own, or measured with those of the first
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from hybridlio.core.errors import DataError
from hybridlio.core.sensors import ImuSamples, Scan
from hybridlio.core.trajectory import read_tum
from hybridlio.datasets.calibration_yaml import StatedCalibration, read_calibration_yaml
from hybridlio.datasets.gps_csv import note_fixes, read_gps_csv
from hybridlio.datasets.imu_csv import read_imu_csv
from hybridlio.datasets.imu_mounting import as_stated, note_mounting
from hybridlio.datasets.kitti.vertical_angle import raised
from hybridlio.datasets.merged_lidars import MergedScans, OtherLidar, nearest_scans
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.points.point_files import SUFFIXES, open_point_files
from hybridlio.datasets.points.scan_folders import (
    STAMP_FILES,
    ScanFiles,
    files_in,
    has_scans,
    named_file,
    note_other_folders,
    scan_files,
    stamp_files,
    stamped,
)
from hybridlio.datasets.reference import poses_at
from hybridlio.datasets.sequence import Sequence
from hybridlio.datasets.stamps import note_coverage

LAYOUT = f"a folder with timestamps.txt, and scans in it or in scans/ ({', '.join(SUFFIXES)})"

_IMU_FILES = ("imu.csv", "imu0/data.csv", "mav0/imu0/data.csv")  # the latter as EuRoC and TUM-VI name them


def find(path: Path) -> dict[str, Path]:
    """Find the recording at ``path``, or those in the folders directly below: folders by name."""
    here = [path] if has_scans(path) else sorted(p for p in path.glob("*") if is_recording(p))
    return {p.resolve().name: p for p in here}


def is_recording(folder: Path) -> bool:
    """Return whether the folder itself is a recording: it has a file of stamps, and scans."""
    return bool(stamp_files(folder)) and has_scans(folder)


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
    imu_file = next((path for name in _IMU_FILES if (path := named_file(folder, name)).is_file()), None)
    imu = read_imu_csv(imu_file, notes) if imu_file else ImuSamples.empty()
    stated = read_calibration_yaml(named_file(folder, "calibration.yaml"), needs_imu=len(imu) > 0)
    scans = stamped(folder, scan_files(folder), stated.rate_hz if rate_hz is None else rate_hz, notes)
    stamps = scans.stamps_ns
    if len(imu):
        imu = as_stated(imu, stated.imu_scale, stated.imu_time_offset_s, notes)
        note_mounting(imu, stated.calibration.T_imu_lidar, notes)
    else:
        notes.add(f"no inertial data: {folder / 'imu.csv'} does not exist")
    note_coverage(imu.stamps_ns, stamps, "inertial data", notes)
    gps = read_gps_csv(named_file(folder, "gps.csv"), notes)
    note_fixes(gps, stamps, notes)
    files = open_point_files(scans.paths, stamps, notes, stated.layout, stated.format)
    load = _with_others(raised(files, vertical_angle_deg), folder, scans, stated, vertical_angle_deg, notes)
    true = named_file(folder, "poses_tum.txt")
    poses = read_tum(true) if true.is_file() else None
    return Sequence(
        name=folder.name,
        stamps_ns=stamps,
        load_scan=load,
        imu=imu,
        calibration=stated.calibration,
        reference=poses_at(stamps, poses.stamps_ns, poses.poses, "rows of poses_tum.txt", notes) if poses else None,
        gps=gps,
        lidar=stated.lidar,
        imu_noise=stated.imu_noise,
        imu_time_offset_s=stated.imu_time_offset_s,
        imu_scale=stated.imu_scale,
        notes=tuple(notes.texts),
    )


def _with_others(
    load: Callable[[int], Scan],
    folder: Path,
    first: ScanFiles,
    stated: StatedCalibration,
    vertical_angle_deg: float | None,
    notes: Notes,
) -> Callable[[int], Scan]:
    """Return the loader of scans, merged with those of the further lidars that ``calibration.yaml`` names."""
    others = []
    for name, T_first_other in stated.lidars.items():
        scans = _other_scans(folder, name, first, notes)
        files = open_point_files(
            scans.paths, scans.stamps_ns, notes, stated.layout, replace(stated.format, vehicle=None)
        )
        nearest = nearest_scans(first.stamps_ns, scans.stamps_ns, name, notes)
        others.append(OtherLidar(name, raised(files, vertical_angle_deg), scans.stamps_ns, T_first_other, nearest))
    note_other_folders(
        folder, {first.paths[0].parent, *(folder / name for name in stated.lidars)}, len(first.paths), notes
    )
    return MergedScans(load, tuple(others), stated.format.vehicle) if others else load


def _other_scans(folder: Path, name: str, first: ScanFiles, notes: Notes) -> ScanFiles:
    """Return the scans of a further lidar; without stamps of their own they are those of the first lidar's scans."""
    paths = files_in(folder / name)
    if not paths:
        raise DataError(f"{folder / 'calibration.yaml'}: lidars: no scans in {folder / name}")
    try:
        return stamped(folder / name, paths, None, notes)
    except DataError:
        if stamp_files(folder / name) or len(paths) != len(first.paths):
            raise
    notes.add(
        f"{name} has no {' or '.join(STAMP_FILES)}: its scans are taken to be measured with those of the first lidar"
    )
    return ScanFiles(paths, first.stamps_ns)
