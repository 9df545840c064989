"""Writer of KITTI's raw-data layout: folders, stamps, calibration, navigation rows and scans."""

from __future__ import annotations

import datetime
import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Stamps
from hybridlio.core.files import write_atomically
from hybridlio.core.geodesy import EARTH_RADIUS_M, GeodeticPoint
from hybridlio.core.sensors import NS_PER_S, Scan
from hybridlio.simulation.drive.path import Motion
from hybridlio.simulation.rig import T_CAMERA_LIDAR, T_LIDAR_IMU

DATE = "2026_01_01"  # of all simulated drives; none of KITTI's dates
# noon of that date
START_NS = int(datetime.datetime(2026, 1, 1, 12, tzinfo=datetime.UTC).timestamp()) * NS_PER_S
FIRST_PLACE = GeodeticPoint(49.0, 8.4, 110.0)  # of the first navigation row: Karlsruhe, where KITTI was recorded
# Status columns of the navigation rows, constant: position and velocity accuracy, navigation status, satellites, and
# three modes; the values are those of undisturbed reception in KITTI's files.
_STATUS = (0.02, 0.01, 4, 10, 5, 5, 6)
_CAMERA_MATRIX = ((720.0, 0, 610, 0), (0, 720, 173, 0), (0, 0, 1, 0))  # near that of KITTI's left camera; no images


@dataclass(frozen=True)
class DriveFolders:
    """Folders of drive ``number`` below ``root``."""

    root: Path
    number: int

    @property
    def date(self) -> Path:
        """The date's folder, with the calibration."""
        return self.root / DATE

    @property
    def sync(self) -> Path:
        """The folder of scans, 10 Hz navigation rows, ground truth and settings."""
        return self.date / f"{DATE}_drive_{self.number:04d}_sync"

    @property
    def extract(self) -> Path:
        """The folder of 100 Hz navigation rows."""
        return self.date / f"{DATE}_drive_{self.number:04d}_extract"

    @property
    def velodyne(self) -> Path:
        """The folder of scans and their stamps."""
        return self.sync / "velodyne_points"


def stamps_text(stamps_ns: Stamps) -> str:
    """Format stamps as KITTI does, one per line: ``2026-01-01 12:00:00.000000000`` (UTC)."""
    texts = np.datetime_as_string(np.asarray(stamps_ns, dtype=np.int64).view("datetime64[ns]"), unit="ns")
    return "".join(text.replace("T", " ") + "\n" for text in texts)


def write_calibration(date: Path) -> None:
    """Write ``calib_imu_to_velo.txt``, ``calib_velo_to_cam.txt`` and ``calib_cam_to_cam.txt`` of the simulated car."""
    write_atomically(date / "calib_imu_to_velo.txt", _rigid_text(T_LIDAR_IMU))
    write_atomically(date / "calib_velo_to_cam.txt", _rigid_text(T_CAMERA_LIDAR))
    rows = {"R_rect_00": np.eye(3), "P_rect_00": np.array(_CAMERA_MATRIX)}
    text = "".join(f"{name}: {' '.join(f'{v:.12e}' for v in value.ravel())}\n" for name, value in rows.items())
    write_atomically(date / "calib_cam_to_cam.txt", "calib_time: 01-Jan-2026 12:00:00\n" + text)


def _rigid_text(T: Array) -> str:
    rotation, translation = (" ".join(f"{v:.15e}" for v in a.ravel()) for a in (T[:3, :3], T[:3, 3]))
    return f"calib_time: 01-Jan-2026 12:00:00\nR: {rotation}\nT: {translation}\n"


def oxts_rows(motion: Motion, origin_m: Array, gyro_rad_s: Array, accel_m_s2: Array) -> Array:
    """Return navigation rows ``(N, 30)``: exact, except for the inertial columns, which are given.

    Latitude and longitude are the inverse of KITTI's Mercator projection at the first row's latitude
    (:mod:`hybridlio.datasets.kitti.oxts`).

    Args:
        motion: of the IMU at ``N`` times.
        origin_m: ``(3,)`` the position of the first row, world frame.
        gyro_rad_s, accel_m_s2: ``(N, 3)`` the IMU's measurements.
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
    status = np.tile(_STATUS, (len(yaw), 1))
    return np.column_stack([*columns, local, accel_m_s2, level_accel, gyro_rad_s, level_gyro, status])


def write_oxts(folder: Path, stamps_ns: Stamps, rows: Array) -> None:
    """Write an ``oxts`` folder: one file per row, and the stamps."""
    data = folder / "data"
    data.mkdir(parents=True, exist_ok=True)
    for k, row in enumerate(rows):
        measured, status = (f"{v:.13g}" for v in row[:25]), (str(round(v)) for v in row[25:])
        (data / f"{k:010d}.txt").write_text(" ".join([*measured, *status]) + "\n")
    write_atomically(folder / "timestamps.txt", stamps_text(stamps_ns))


def write_scan(velodyne: Path, index: int, scan: Scan) -> None:
    """Write ``data/NNNNNNNNNN.bin`` (float32 x y z reflectance), and ``offsets/NNNNNNNNNN.npy`` if points have times.

    The ``.bin`` is written last, so that an existing one marks a complete scan.
    """
    if scan.time_offsets_ns is not None:
        buffer = io.BytesIO()
        np.save(buffer, scan.time_offsets_ns)
        write_atomically(velodyne / "offsets" / f"{index:010d}.npy", buffer.getvalue())
    intensity = np.zeros(len(scan), np.float32) if scan.intensity is None else scan.intensity
    rows = np.column_stack([scan.points, intensity]).astype("<f4")
    write_atomically(velodyne / "data" / f"{index:010d}.bin", rows.tobytes())


def pose_rows(poses: Array) -> str:
    """Format poses ``(N, 4, 4)`` relative to the first as KITTI does, 12 numbers a row, with 16 significant digits."""
    relative = se3.between(poses[0], poses)
    return "".join(" ".join(f"{v:.15e}" for v in row) + "\n" for row in relative[:, :3].reshape(-1, 12))
