"""KITTI's raw-data layout: folders, stamps, calibration, navigation rows and scans."""

from __future__ import annotations

import datetime
import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.files import write_atomically
from hybridlio.core.geodesy import EARTH_RADIUS_M, GeodeticPoint
from hybridlio.core.sensors import Scan
from hybridlio.simulation.drive.path import Motion
from hybridlio.simulation.rig import T_CAMERA_LIDAR, T_LIDAR_IMU

DATE = "2026_01_01"
START_NS = int(datetime.datetime(2026, 1, 1, 12, tzinfo=datetime.UTC).timestamp()) * 1_000_000_000
FIRST_PLACE = GeodeticPoint(49.0, 8.4, 110.0)  # of the first row


@dataclass(frozen=True)
class DriveFolders:
    """Where the parts of drive ``number`` lie below ``root``."""

    root: Path
    number: int

    @property
    def date(self) -> Path:
        """Both drives' parent, with the calibration."""
        return self.root / DATE

    @property
    def sync(self) -> Path:
        """Scans, navigation rows at 10 Hz, the truth and the settings."""
        return self.date / f"{DATE}_drive_{self.number:04d}_sync"

    @property
    def extract(self) -> Path:
        """Navigation rows at 100 Hz."""
        return self.date / f"{DATE}_drive_{self.number:04d}_extract"

    @property
    def velodyne(self) -> Path:
        """Scans and their stamps."""
        return self.sync / "velodyne_points"


def stamps_text(stamps_ns: NDArray[np.int64]) -> str:
    """Stamps as KITTI writes them, one a line: ``2026-01-01 12:00:00.000000000`` (UTC)."""
    texts = np.datetime_as_string(np.asarray(stamps_ns, dtype=np.int64).view("datetime64[ns]"), unit="ns")
    return "".join(text.replace("T", " ") + "\n" for text in texts)


def write_calibration(date: Path) -> None:
    """``calib_imu_to_velo.txt``, ``calib_velo_to_cam.txt`` and ``calib_cam_to_cam.txt`` of the simulated car."""
    write_atomically(date / "calib_imu_to_velo.txt", _rigid_text(T_LIDAR_IMU))
    write_atomically(date / "calib_velo_to_cam.txt", _rigid_text(T_CAMERA_LIDAR))
    rows = {"R_rect_00": np.eye(3), "P_rect_00": np.array([[720.0, 0, 610, 0], [0, 720, 173, 0], [0, 0, 1, 0]])}
    text = "".join(f"{name}: {' '.join(f'{v:.12e}' for v in value.ravel())}\n" for name, value in rows.items())
    write_atomically(date / "calib_cam_to_cam.txt", "calib_time: 01-Jan-2026 12:00:00\n" + text)


def _rigid_text(T: Array) -> str:
    rotation, translation = (" ".join(f"{v:.15e}" for v in a.ravel()) for a in (T[:3, :3], T[:3, 3]))
    return f"calib_time: 01-Jan-2026 12:00:00\nR: {rotation}\nT: {translation}\n"


def oxts_rows(motion: Motion, origin_m: Array, gyro_rad_s: Array, accel_m_s2: Array) -> Array:
    """Navigation rows ``(N, 30)``, true but for the inertial columns, which are ``gyro_rad_s`` and ``accel_m_s2``.

    Latitude and longitude are those that KITTI's Mercator projection, at the first row's latitude, takes back to the
    position relative to ``origin_m`` ``(3,)``, the position of the first row.
    """
    R = motion.poses[:, :3, :3]
    yaw, pitch, roll = Rotation.from_matrix(R).as_euler("ZYX").T
    east, north, up = (motion.poses[:, :3, 3] - origin_m).T
    scale = EARTH_RADIUS_M * np.cos(np.radians(FIRST_PLACE.latitude_deg))
    mercator = np.log(np.tan(np.pi / 4 + np.radians(FIRST_PLACE.latitude_deg) / 2)) + north / scale
    latitude = np.degrees(2 * np.arctan(np.exp(mercator)) - np.pi / 2)
    longitude = FIRST_PLACE.longitude_deg + np.degrees(east / scale)
    level = Rotation.from_euler("ZYX", np.column_stack([0 * yaw, pitch, roll])).as_matrix()
    heading = Rotation.from_euler("Z", yaw[:, None]).as_matrix()
    local = np.einsum("nji,nj->ni", heading, motion.velocity_m_s)
    level_accel, level_gyro = (np.einsum("nij,nj->ni", level, v) for v in (accel_m_s2, gyro_rad_s))
    velocity = motion.velocity_m_s
    columns = [latitude, longitude, FIRST_PLACE.height_m + up, roll, pitch, yaw, velocity[:, 1], velocity[:, 0]]
    status = np.tile([0.02, 0.01, 4, 10, 5, 5, 6], (len(yaw), 1))
    return np.column_stack([*columns, local, accel_m_s2, level_accel, gyro_rad_s, level_gyro, status])


def write_oxts(folder: Path, stamps_ns: NDArray[np.int64], rows: Array) -> None:
    """An ``oxts`` folder: one file a row, and the stamps."""
    data = folder / "data"
    data.mkdir(parents=True, exist_ok=True)
    for k, row in enumerate(rows):
        measured, status = (f"{v:.13g}" for v in row[:25]), (str(round(v)) for v in row[25:])
        (data / f"{k:010d}.txt").write_text(" ".join([*measured, *status]) + "\n")
    write_atomically(folder / "timestamps.txt", stamps_text(stamps_ns))


def write_scan(velodyne: Path, index: int, scan: Scan) -> None:
    """``data/NNNNNNNNNN.bin`` (float32 x y z reflectance), and ``offsets/NNNNNNNNNN.npy`` where points have times.

    The ``.bin`` comes last, so a scan that is there is complete.
    """
    if scan.time_offsets_ns is not None:
        buffer = io.BytesIO()
        np.save(buffer, scan.time_offsets_ns)
        write_atomically(velodyne / "offsets" / f"{index:010d}.npy", buffer.getvalue())
    intensity = np.zeros(len(scan), np.float32) if scan.intensity is None else scan.intensity
    rows = np.column_stack([scan.points, intensity]).astype("<f4")
    write_atomically(velodyne / "data" / f"{index:010d}.bin", rows.tobytes())


def pose_rows(poses: Array) -> str:
    """Poses ``(N, 4, 4)`` in KITTI's format, 12 numbers a row, with 15 significant digits, from the first pose."""
    relative = se3.between(poses[0], poses)
    return "".join(" ".join(f"{v:.15e}" for v in row) + "\n" for row in relative[:, :3].reshape(-1, 12))
