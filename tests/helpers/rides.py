"""A short ride in closed form, written in the layout of every reader."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import bags
import numpy as np
from scipy.spatial.transform import Rotation

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Stamps
from hybridlio.core.sensors import ImuSamples, Scan
from hybridlio.core.trajectory import Trajectory, write_kitti, write_tum

EARTH_RADIUS_M, LATITUDE_DEG, LONGITUDE_DEG = 6378137.0, 49.0, 8.4
SPEED_M_S, YAW_RATE_RAD_S = 8.0, 0.2
MS = 1_000_000


@dataclass(frozen=True)
class Ride:
    """A circle at constant speed: the twist is constant, so interpolation along geodesics is exact."""

    count: int = 12
    start_ns: int = 1_317_384_000_123_456_789  # 2011-09-30 12:00:00.123456789
    T_imu_lidar: Array = field(default_factory=lambda: se3.exp([0.01, -0.02, 0.015, 0.81, -0.31, 0.8]))
    T_camera_lidar: Array = field(
        default_factory=lambda: se3.make([[0, -1, 0], [0, 0, -1], [1, 0, 0]], [0.0, -0.08, -0.27])
    )

    @property
    def stamps_ns(self) -> Stamps:
        return self.start_ns + np.arange(self.count) * 100 * MS

    def T_enu_imu(self, stamps_ns: Stamps) -> Array:
        seconds = (np.asarray(stamps_ns) - self.start_ns) / 1e9
        twist = np.array([0, 0, YAW_RATE_RAD_S, SPEED_M_S, 0, 0])
        return se3.exp([0.02, -0.01, 0.5, 0, 0, 0]) @ se3.exp(seconds[:, None] * twist)

    @property
    def lidar(self) -> Trajectory:
        return Trajectory(self.stamps_ns, self.T_enu_imu(self.stamps_ns) @ self.T_imu_lidar).from_first()

    def imu(self, stamps_ns: Stamps) -> ImuSamples:
        rows = np.ones((len(stamps_ns), 1))
        return ImuSamples(stamps_ns, rows * [0, 0, YAW_RATE_RAD_S], rows * [0, SPEED_M_S * YAW_RATE_RAD_S, 9.81])

    def imu_stamps_ns(self, period_ms: int) -> Stamps:
        return np.arange(self.stamps_ns[0] - 30 * MS, self.stamps_ns[-1] + 130 * MS, period_ms * MS)

    def points(self, k: int) -> Array:
        return np.random.default_rng(k).uniform(-20, 20, size=(50 + k, 4)) * [1, 1, 0.1, 0.02] + [0, 0, 0, 0.5]

    def oxts_rows(self, stamps_ns: Stamps) -> Array:
        """Return KITTI's 30 columns, with the inverse of the Mercator projection at the ride's start."""
        T, imu = self.T_enu_imu(stamps_ns), self.imu(np.arange(len(stamps_ns)))  # the same at all times
        scale = EARTH_RADIUS_M * np.cos(np.radians(LATITUDE_DEG))
        north = np.arcsinh(np.tan(np.radians(LATITUDE_DEG))) + T[:, 1, 3] / scale
        rows = np.zeros((len(stamps_ns), 30))
        rows[:, 0], rows[:, 1] = np.degrees(np.arctan(np.sinh(north))), LONGITUDE_DEG + np.degrees(T[:, 0, 3] / scale)
        rows[:, 2] = 112.0 + T[:, 2, 3]
        rows[:, 3:6] = Rotation.from_matrix(T[:, :3, :3]).as_euler("ZYX")[:, ::-1]
        rows[:, 8], rows[:, 11:14], rows[:, 17:20] = SPEED_M_S, imu.accel_m_s2, imu.gyro_rad_s
        rows[:, 14:17] = rows[:, 20:23] = -99.0  # the earth-tangential columns, which are not the body's
        return rows


def iso(stamp_ns: int) -> str:
    return str(np.datetime64(int(stamp_ns), "ns")).replace("T", " ")


def put(path: Path, data: bytes | str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data.encode() if isinstance(data, str) else data)
    return path


def put_bin(path: Path, points: Array) -> Path:
    return put(path, np.asarray(points, dtype="<f4").tobytes())


def put_oxts(folder: Path, ride: Ride, stamps_ns: Stamps) -> None:
    put_rows(folder, stamps_ns, ride.oxts_rows(stamps_ns))


def put_rows(folder: Path, stamps_ns: Stamps, rows: Array) -> None:
    put(folder / "timestamps.txt", "".join(f"{iso(t)}\n" for t in stamps_ns))
    for k, row in enumerate(rows):
        put(folder / f"data/{k:010d}.txt", " ".join(f"{v:.14g}" for v in row) + "\n")


def put_calibration(date: Path, ride: Ride) -> None:
    def rows(T: Array) -> str:
        R, t = " ".join(map(str, T[:3, :3].ravel())), " ".join(map(str, T[:3, 3]))
        return f"calib_time: 25-May-2012 16:47:16\nR: {R}\nT: {t}\n"

    put(date / "calib_imu_to_velo.txt", rows(se3.inverse(ride.T_imu_lidar)))
    put(date / "calib_velo_to_cam.txt", rows(ride.T_camera_lidar))


def write_raw(
    root: Path, ride: Ride, name: str = "2011_09_30_drive_0016", extract: bool = True, own_stamps: bool = True
) -> Path:
    """Write the ride as a KITTI raw drive; return its ``_sync`` folder."""
    date = root / name[:10]
    drive = date / f"{name}_sync"
    put_calibration(date, ride)
    put_oxts(drive / "oxts", ride, ride.stamps_ns + 4 * MS)
    put(drive / "image_00/timestamps.txt", "".join(f"{iso(t)}\n" for t in ride.stamps_ns))
    if own_stamps:
        put(drive / "velodyne_points/timestamps.txt", "".join(f"{iso(t)}\n" for t in ride.stamps_ns))
    for k in range(ride.count):
        put_bin(drive / f"velodyne_points/data/{k:010d}.bin", ride.points(k))
    if extract:
        put_oxts(date / f"{name}_extract/oxts", ride, ride.imu_stamps_ns(10))
    return drive


def write_odometry(root: Path, ride: Ride, name: str = "04") -> Path:
    """Write the ride as a KITTI odometry sequence; return its folder."""
    folder = root / "sequences" / name
    Tr = " ".join(map(str, ride.T_camera_lidar[:3].ravel()))
    put(folder / "calib.txt", f"P0: {'1 ' * 12}\nTr: {Tr}\n")
    put(folder / "times.txt", "".join(f"{(t - ride.start_ns) / 1e9:.6e}\n" for t in ride.stamps_ns))
    for k in range(ride.count):
        put_bin(folder / f"velodyne/{k:06d}.bin", ride.points(k))
    write_kitti(root / "poses" / f"{name}.txt", ride.lidar, ride.T_camera_lidar)
    return folder


def imu_csv(imu: ImuSamples) -> str:
    rows = zip(imu.stamps_ns.tolist(), np.hstack([imu.gyro_rad_s, imu.accel_m_s2]).tolist(), strict=True)
    return "stamp_ns,gx,gy,gz,ax,ay,az\n" + "".join(f"{t},{','.join(map(str, row))}\n" for t, row in rows)


def calibration_yaml(ride: Ride) -> str:
    return f"T_imu_lidar: {ride.T_imu_lidar.tolist()}\n"


def write_folder(root: Path, ride: Ride, write_scan: Callable[[Path, Array], Any] | None = None) -> Path:
    """Write the ride as a plain folder; return it. Scans are ``.npy`` unless ``write_scan`` writes ``scans/<k>``."""
    folder = root / "ride"
    for k in range(ride.count):
        path = folder / f"scans/{k}"
        path.parent.mkdir(parents=True, exist_ok=True)
        if write_scan is None:
            np.save(path, ride.points(k).astype(np.float32))
        else:
            write_scan(path, ride.points(k))
    put(folder / "timestamps.txt", "".join(f"{t}\n" for t in ride.stamps_ns))
    put(folder / "imu.csv", imu_csv(ride.imu(ride.imu_stamps_ns(10))))
    put(folder / "calibration.yaml", calibration_yaml(ride))
    write_tum(folder / "poses_tum.txt", ride.lidar)
    return folder


def write_bag(root: Path, ride: Ride, kind: str = "sqlite3") -> Path:
    """Write the ride as a bag; return its folder or file.

    Args:
        root: where to write.
        ride: the ride.
        kind: ``sqlite3``, ``mcap``, or ``zstd`` for MCAP with compression, for ROS 2; ``ros1``, or ``lz4`` for ROS 1
            with compression.
    """
    storage, compress = {"zstd": ("mcap", "storage"), "ros1": ("", ""), "lz4": ("", "lz4")}.get(kind, (kind, ""))
    is_ros2 = storage != ""
    messages = bags.Messages(is_ros2)
    points = [ride.points(k).astype(np.float32) for k in range(ride.count)]
    scans = [Scan(int(t), p[:, :3], p[:, 3]) for t, p in zip(ride.stamps_ns, points, strict=True)]
    imu = ride.imu(ride.imu_stamps_ns(10))
    content = bags.drive_messages(messages, scans, imu, ride.T_imu_lidar, ride.lidar)
    root.mkdir(parents=True, exist_ok=True)
    path = root / ("ride" if is_ros2 else "ride.bag")
    return bags.write(path, messages, content, storage, compress)
