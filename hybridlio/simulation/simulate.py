"""Simulation of a drive, written as KITTI raw data."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from hybridlio.core.errors import DataError
from hybridlio.core.files import locked, write_atomically
from hybridlio.core.geodesy import origin_of
from hybridlio.core.progress import Progress
from hybridlio.core.sensors import NS_PER_S
from hybridlio.datasets.protection import check_output
from hybridlio.simulation.config import SimulationConfig
from hybridlio.simulation.kitti_writer import (
    FIRST_PLACE,
    START_NS,
    DriveFolders,
    oxts_rows,
    pose_rows,
    stamps_text,
    write_calibration,
    write_oxts,
    write_scan,
)
from hybridlio.simulation.measurements import (
    IMU_PER_SCAN,
    LEAD_TICKS,
    imu_samples,
    imu_ticks,
    lidar_poses,
    scan_at,
    scan_stamps_ns,
)
from hybridlio.simulation.plan import Drive, plan
from hybridlio.simulation.random_streams import RandomStream
from hybridlio.simulation.rig import IMU_RATE_HZ
from hybridlio.simulation.sensors.gps import gps_csv, gps_fixes
from hybridlio.simulation.sensors.lidar import ray_pattern

FORMAT_VERSION = 1


def simulate(out: Path, config: SimulationConfig, progress: Progress | None = None) -> Path:
    """Simulate a drive and write it below ``out`` as KITTI raw data.

    The drive appears when it is complete. Until then it is in a hidden folder of ``out``, from which a later run with
    the same settings resumes after an interrupt. A finished drive with the same settings is not simulated again.

    Args:
        out: the folder to write to; created if missing.
        config: the settings.
        progress: called after each scan with an empty stage, scans done and scans in total.

    Returns:
        The drive's folder, ``OUT/<date>/<date>_drive_NNNN_sync``. Besides KITTI's files it holds ``poses.txt`` (exact
        lidar poses in the first scan's frame), ``simulation.json`` and, with ``config.gps``, ``gps.csv``. The
        calibration and the 100 Hz rows (``…_extract``) are beside it.

    Raises:
        DataError: ``out`` holds a drive of this seed with other settings, or other files in its place, or cannot be
            written to, or the pose file is malformed.
        ConfigError: there is no such pose file, or ``out`` is or lies inside a recording.
    """
    check_output(out, may_hold=True)
    description = describe(config)
    done = DriveFolders(Path(out), config.own_seed % 10000)
    if done.sync.exists():
        _require_same(done.sync, description)
        return done.sync
    partial = DriveFolders(Path(out) / f".partial-{_fingerprint(description)}", done.number)
    drive = plan(config)
    with locked(partial.root / ".lock"):
        if not done.sync.exists():  # another process may have simulated it meanwhile
            _write_measurements(partial, drive, config)
            _write_scans(partial, drive, config, progress)
            write_atomically(partial.sync / "simulation.json", json.dumps(description, indent=2) + "\n")
            _move(partial, done)
        shutil.rmtree(partial.root, ignore_errors=True)
    return done.sync


def _move(partial: DriveFolders, done: DriveFolders) -> None:
    """Move a drive to its place. The ``sync`` folder, whose existence marks a finished drive, is moved last."""
    write_calibration(partial.date)
    done.date.mkdir(parents=True, exist_ok=True)
    for source in sorted(partial.date.glob("calib_*.txt")):
        _move_new(source, done.date / source.name)
    for source, target in ((partial.extract, done.extract), (partial.sync, done.sync)):
        _move_new(source, target)


def _move_new(source: Path, target: Path) -> None:
    """Move a file or folder to its place, which is free, or holds the same already after a killed move.

    Raises:
        DataError: it holds something else, which this program did not write.
    """
    if target.exists() or target.is_symlink():
        if not _are_equal(source, target):
            raise DataError(f"{target} exists and is not of this simulation; choose another folder")
        return
    source.rename(target)


def _are_equal(a: Path, b: Path) -> bool:
    """Return whether two files, or all files of two folders, are equal to the last byte."""
    if a.is_file() or b.is_file():
        return a.is_file() and b.is_file() and a.read_bytes() == b.read_bytes()
    files, others = ({p.relative_to(root) for p in root.rglob("*") if p.is_file()} for root in (a, b))
    return files == others and all((a / name).read_bytes() == (b / name).read_bytes() for name in files)


def describe(config: SimulationConfig) -> dict[str, Any]:
    """Return the content of ``simulation.json``: settings, sensors, and the hash of a pose file."""
    settings = json.loads(config.model_dump_json())
    sensors = {"lidar": settings["lidar"], "imu_noise": settings["imu_noise"]}  # these two are for the reader
    description: dict[str, Any] = {"version": FORMAT_VERSION, **sensors, "config": settings}
    if config.poses is not None:
        description["poses_sha256"] = hashlib.sha256(config.require_poses().read_bytes()).hexdigest()
        description["config"]["poses"] = config.poses.name
    return description


def _fingerprint(description: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(description, sort_keys=True).encode()).hexdigest()[:12]


def _require_same(drive: Path, description: dict[str, Any]) -> None:
    path = drive / "simulation.json"
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        raise DataError(f"{drive} exists and is no simulated drive; choose another folder") from None
    if _completed(found) != description:
        raise DataError(
            f"{path} describes another drive. Folders are numbered by the last four digits of the seed; choose another "
            "folder or seed"
        )


def _completed(found: Any) -> Any:
    """Return the description with defaults for settings that did not exist when it was written."""
    if not isinstance(found, dict) or not isinstance(found.get("config"), dict):
        return found
    return {**found, "config": json.loads(SimulationConfig().model_dump_json()) | found["config"]}


def _write_measurements(folders: DriveFolders, drive: Drive, config: SimulationConfig) -> None:
    """Write everything except scans and calibration: stamps, navigation rows, ground truth, GPS."""
    scan_stamps, imu = scan_stamps_ns(drive), imu_samples(drive, config)
    origin = drive.path.poses(0.0)[0, :3, 3]
    motion = drive.path.motion(imu_ticks(drive) / IMU_RATE_HZ)
    rows = oxts_rows(motion, origin, imu.gyro_rad_s, imu.accel_m_s2)
    write_oxts(folders.extract / "oxts", imu.stamps_ns, rows)
    write_oxts(folders.sync / "oxts", scan_stamps, rows[LEAD_TICKS : len(rows) - LEAD_TICKS : IMU_PER_SCAN])
    half_turn = round(NS_PER_S / config.lidar_model.rate_hz / 2) if config.motion_distortion else 0
    for name, shift in (("timestamps", 0), ("timestamps_start", -half_turn), ("timestamps_end", half_turn)):
        write_atomically(folders.velodyne / f"{name}.txt", stamps_text(scan_stamps + shift))
    write_atomically(folders.sync / "poses.txt", pose_rows(lidar_poses(drive)))
    if config.gps:
        fix_times = np.arange(0.0, drive.scan_times_s[-1] + 1e-9, 1.0 / config.gps_rate_hz)
        noise = np.random.default_rng([config.own_seed, RandomStream.GPS])
        place = origin_of(origin, FIRST_PLACE)
        fixes = gps_fixes(drive.path, fix_times, START_NS, config.gps_sigma_m, noise, place)
        write_atomically(folders.sync / "gps.csv", gps_csv(fixes))


def _write_scans(folders: DriveFolders, drive: Drive, config: SimulationConfig, progress: Progress | None) -> None:
    pattern, total = ray_pattern(config.lidar_model), len(drive.scan_times_s)
    for k in range(total):
        if not (folders.velodyne / "data" / f"{k:010d}.bin").exists():
            write_scan(folders.velodyne, k, scan_at(drive, k, pattern, config))
        if progress is not None:
            progress("", k + 1, total)
