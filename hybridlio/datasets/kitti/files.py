"""KITTI's file formats: calibrations, numbered files, scans; and the sensors that a simulated drive describes."""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Floats, Index, Stamps
from hybridlio.core.errors import DataError
from hybridlio.core.lidar_models import LIDAR_MODELS, LidarModel
from hybridlio.core.sensors import Calibration, ImuNoise, Scan

KITTI_LIDAR = LIDAR_MODELS["hdl-64e"]  # Geiger et al., "Vision meets Robotics: The KITTI Dataset", IJRR 2013
_BYTES_PER_POINT = 16  # x y z reflectance, float32


def read_calibration(path: Path) -> dict[str, Array]:
    """Read the numeric ``name: values`` rows of a KITTI calibration file; skip others, such as dates.

    Raises:
        DataError: the file is missing.
    """
    if not path.is_file():
        raise DataError(f"{path}: missing calibration; download the calibration files and unpack them there")
    rows = {}
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        name, _, values = line.partition(":")
        try:
            rows[name.strip()] = np.array(values.split(), dtype=np.float64)
        except ValueError:
            continue
    return rows


def rows_of(calibration: dict[str, Array], path: Path, *names: str) -> tuple[Array, ...]:
    """Return rows of a calibration: 12 numbers as ``(3, 4)``, 9 as ``(3, 3)``, 3 as ``(3,)``.

    Raises:
        DataError: a row is missing, has another number of values, or is not finite; the message names ``path``.
    """
    found = []
    for name in names:
        values = calibration.get(name, np.empty(0))
        if len(values) not in (3, 9, 12) or not np.isfinite(values).all():
            raise DataError(f"{path}: expected a row '{name}:' of 3, 9 or 12 finite numbers, found {len(values)}")
        found.append(values.reshape(3, -1) if len(values) > 3 else values)
    return tuple(found)


def read_rigid(path: Path) -> Array:
    """Read the transform ``(4, 4)`` of a raw-data calibration file, from its rows ``R:`` and ``T:``.

    Raises:
        DataError: the file or a row is missing, or the rows are no rigid transform.
    """
    R, t = rows_of(read_calibration(path), path, "R", "T")
    if R.shape != (3, 3) or t.shape != (3,):
        raise DataError(f"{path}: expected 9 numbers in 'R:' and 3 in 'T:', found {R.size} and {t.size}")
    return se3.check_pose(se3.make(R, t), str(path))


def read_drive_calibration(drive: Path, needs_imu: bool) -> Calibration:
    """Read the extrinsics of a raw drive, from the drive's own folder or from its date's.

    ``T_imu_lidar`` comes from ``calib_imu_to_velo.txt``, without that file it is the identity. ``T_camera_lidar`` comes
    from ``calib_velo_to_cam.txt`` and is of the rectified camera if ``calib_cam_to_cam.txt`` has ``R_rect_00``.

    Args:
        drive: the drive's folder.
        needs_imu: whether there are inertial data, which need ``calib_imu_to_velo.txt``.

    Raises:
        DataError: ``calib_imu_to_velo.txt`` is needed and missing, or a file is malformed.
    """
    imu_to_velo, velo_to_cam, cam_to_cam = (
        calibration_file(drive, f"calib_{name}.txt") for name in ("imu_to_velo", "velo_to_cam", "cam_to_cam")
    )
    if needs_imu and not imu_to_velo.is_file():
        raise DataError(
            f"{imu_to_velo}: missing calibration, which inertial data need; download it, or write the rows 'R:' with 9 "
            "numbers and 'T:' with 3, a transform that maps IMU points into the lidar frame"
        )
    T_imu_lidar = se3.inverse(read_rigid(imu_to_velo)) if imu_to_velo.is_file() else np.eye(4)
    T_camera_lidar = read_rigid(velo_to_cam) if velo_to_cam.is_file() else None
    if T_camera_lidar is not None and cam_to_cam.is_file():
        (R_rect,) = rows_of(read_calibration(cam_to_cam), cam_to_cam, "R_rect_00")
        T_camera_lidar = se3.make(R_rect, np.zeros(3)) @ T_camera_lidar
    return Calibration(T_imu_lidar, T_camera_lidar)


def calibration_file(drive: Path, name: str) -> Path:
    """Return the path of a calibration file: the drive's own if it exists, else its date's."""
    own = drive / name
    return own if own.is_file() else drive.parent / name


def numbered(folder: Path, suffix: str) -> tuple[Index, tuple[Path, ...]]:
    """List the files of a folder that are named by a number: the numbers ``(N,)``, ascending, and the paths."""
    found = sorted((int(p.stem), p) for p in folder.glob(f"*{suffix}") if p.stem.isdigit()) if folder.is_dir() else []
    return np.array([number for number, _ in found], dtype=np.int64), tuple(path for _, path in found)


def read_bin(path: Path) -> tuple[Floats, Floats]:
    """Read points ``(N, 3)`` in metres and reflectances ``(N,)`` of a ``.bin`` scan: float32 x y z reflectance.

    Raises:
        DataError: the file is missing, empty, or truncated (its size is no multiple of 16 bytes).
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DataError(f"{path}: cannot read the scan ({error.strerror})") from None
    if not data:
        raise DataError(f"{path}: the scan has no points (0 bytes)")
    if len(data) % _BYTES_PER_POINT:
        raise DataError(
            f"{path}: truncated scan, {len(data)} bytes is no multiple of {_BYTES_PER_POINT} (4 float32 a point)"
        )
    values = np.frombuffer(data, dtype="<f4").reshape(-1, 4)
    return values[:, :3], values[:, 3]


@dataclass(frozen=True)
class BinScans:
    """Loads scan ``k`` from ``paths[k]``. An object rather than a closure, so that it can be pickled.

    Attributes:
        paths: one ``.bin`` file per scan.
        stamps_ns: one stamp per scan.
        offsets: a folder with the time offset of each point, ``<scan's name>.npy`` of int64 nanoseconds, or None.
    """

    paths: tuple[Path, ...]
    stamps_ns: Stamps
    offsets: Path | None = None

    def __call__(self, k: int) -> Scan:
        """Load scan ``k``.

        Raises:
            DataError: the file is missing, truncated, or without a finite point; the message names frame and file.
        """
        path = self.paths[k]
        try:
            points, intensity = read_bin(path)
            scan = Scan(int(self.stamps_ns[k]), points, intensity, self._offsets_ns(path))
        except DataError as error:
            raise DataError(f"frame {k}: {error}") from None
        if not len(scan):
            raise DataError(f"frame {k}: {path}: the scan has no finite points")
        return scan

    def _offsets_ns(self, scan: Path) -> Stamps | None:
        if self.offsets is None:
            return None
        path = self.offsets / f"{scan.stem}.npy"
        try:
            return np.asarray(np.load(path, allow_pickle=False), dtype=np.int64)
        except (OSError, ValueError, EOFError) as error:
            raise DataError(f"{path}: cannot read the points' time offsets ({error})") from None


@dataclass(frozen=True)
class SimulatedSensors:
    """The sensors that a simulated drive describes in ``simulation.json``."""

    lidar: LidarModel
    imu_noise: ImuNoise | None


def read_simulation(path: Path) -> SimulatedSensors | None:
    """Read the sensors from ``simulation.json``; None if the file does not exist.

    Raises:
        DataError: the file is not JSON, the lidar is unknown, or a noise value is not a number of 0 or more.
    """
    if not path.is_file():
        return None
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise DataError(f"{path}: not JSON ({error})") from None
    if not isinstance(content, dict):
        raise DataError(f"{path}: expected an object with 'lidar' and 'imu_noise'")
    return SimulatedSensors(_lidar(path, content), _imu_noise(path, content.get("imu_noise")))


def _lidar(path: Path, content: dict[str, Any]) -> LidarModel:
    name = content.get("lidar")
    if name not in LIDAR_MODELS:
        raise DataError(f"{path}: unknown lidar {name!r}; known: {', '.join(LIDAR_MODELS)}")
    return LIDAR_MODELS[name]


def _imu_noise(path: Path, values: Any) -> ImuNoise | None:
    if not values:
        return None
    if not isinstance(values, dict):
        raise DataError(f"{path}: imu_noise: expected an object of numbers")
    try:
        return ImuNoise(**{f.name: float(values[f.name]) for f in fields(ImuNoise) if f.name in values})
    except (ValueError, TypeError) as error:
        raise DataError(f"{path}: imu_noise: {error}") from None
