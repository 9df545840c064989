"""The record of any odometry, from files and arrays: what ``smooth`` takes beside a record of its own."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias, TypedDict, cast

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Stamps
from hybridlio.core.errors import ConfigError, DataError
from hybridlio.core.se3 import as_floats
from hybridlio.core.sensors import NS_PER_S, Calibration, GpsFix, ImuNoise, ImuSamples
from hybridlio.core.trajectory import Trajectory, is_tum_file, read_kitti, read_tum
from hybridlio.datasets.calibration_yaml import StatedCalibration, read_calibration_yaml
from hybridlio.datasets.gps_csv import read_gps_csv
from hybridlio.datasets.imu_csv import read_imu_csv
from hybridlio.datasets.imu_faults import without_filled_gaps
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.stamps import read_stamps
from hybridlio.record.loop_keyframes import LoopKeyframes
from hybridlio.record.record import Record
from hybridlio.record.wheel_speeds import WheelSpeeds

PathLike: TypeAlias = "str | os.PathLike[str]"
Odometry: TypeAlias = "Record | Trajectory | PathLike | ArrayLike"
Imu: TypeAlias = "ImuSamples | PathLike | ArrayLike"
Fixes: TypeAlias = "Sequence[GpsFix] | PathLike | ArrayLike"

_RECORD, _KEYFRAMES = "odometry.npz", "keyframes.npz"  # in a run folder


class OdometryInputs(TypedDict, total=False):
    """Measurements beside the poses of an odometry that is not hybridlio's, from files or arrays.

    Attributes:
        imu: raw samples: an ``imu.csv``, samples, or rows ``t_s, gx, gy, gz, ax, ay, az`` in rad/s and m/s².
        fixes: GPS: a ``gps.csv``, fixes, or rows ``t_s, east, north, up, sigma_m``.
        calibration: a ``calibration.yaml``, or extrinsics; by default the IMU frame is that of the poses.
        covariances: of the steps, ``(N-1, 6, 6)`` or ``(6, 6)``; by default found from the IMU.
        imu_noise: noise densities; by default those of ``calibration``, else of a MEMS unit.
        imu_time_offset_s: to add to the IMU's stamps; by default as ``calibration`` states it, else found.
        wheels: speeds of wheels or velocities of the body, or their CSV file; beside a record too.
        stamps: of poses without any, such as KITTI's: a file with a stamp in seconds a line, or ``(N,)`` int64 ns.
    """

    imu: Imu
    fixes: Fixes
    calibration: Calibration | PathLike
    covariances: ArrayLike
    imu_noise: ImuNoise
    imu_time_offset_s: float
    wheels: WheelSpeeds | PathLike
    stamps: Stamps | PathLike


def record_of(odometry: Odometry, inputs: OdometryInputs, with_keyframes: bool = False) -> Record:
    """Return the record of an odometry.

    Args:
        odometry: a record, or the folder or ``odometry.npz`` of a run; or poses of any odometry: a TUM, KITTI or EuRoC
            file, a trajectory, poses ``(N, 4, 4)`` with ``stamps``, or rows ``t_s, x, y, z, qx, qy, qz, qw``.
        inputs: what was measured beside poses; nothing beside a record.
        with_keyframes: whether loops are to be searched in a run's folder.

    Raises:
        ConfigError: an unknown input, or inputs beside a record.
        DataError: a file or an array that is malformed.
    """
    unknown = sorted(set(inputs) - set(OdometryInputs.__annotations__))
    if unknown:
        known = ", ".join(OdometryInputs.__annotations__)
        raise ConfigError(f"smooth: there is no argument {unknown[0]!r}; beside poses it takes {known}")
    stored = odometry if isinstance(odometry, Record) else _stored(odometry, with_keyframes)
    if stored is not None:
        if inputs:
            raise ConfigError(f"smooth: {', '.join(inputs)} given beside a record, which has its own")
        return stored
    stated = _calibration(inputs.get("calibration"))
    notes: list[str] = []
    imu = _imu(inputs.get("imu"), notes)
    imu = None if imu is None else stated.imu_scale.corrected(imu)
    poses = poses_of(cast("Any", odometry), inputs.get("stamps"), stated.calibration.T_camera_lidar)
    record = Record.from_odometry(
        poses, imu, fixes_of(inputs.get("fixes"), notes), stated.calibration,
        inputs.get("imu_noise", stated.imu_noise), inputs.get("covariances"),
        inputs.get("imu_time_offset_s", stated.imu_time_offset_s),
    )  # fmt: skip
    return replace(record, notes=(*notes, *record.notes))


def _stored(odometry: Any, with_keyframes: bool) -> Record | None:
    """Return the record of a run's folder or file; None for anything else."""
    if not isinstance(odometry, str | os.PathLike):
        return None
    path = Path(odometry)
    path = path / _RECORD if path.is_dir() else path
    if path.suffix != ".npz":
        return None
    record, keyframes = Record.load(path), path.with_name(_KEYFRAMES)
    return replace(record, keyframes=LoopKeyframes.load(keyframes)) if with_keyframes else record


def poses_of(source: Any, stamps: Any = None, T_camera_lidar: Array | None = None) -> Trajectory:
    """Return poses from a file, a trajectory or an array; see :func:`record_of`.

    ``T_camera_lidar`` is that of KITTI files, which hold poses of a camera.
    """
    if isinstance(source, Trajectory):
        return source
    known = read_stamps(Path(stamps)) if isinstance(stamps, str | os.PathLike) else stamps
    if isinstance(source, str | os.PathLike):
        return _pose_file(Path(source), known, T_camera_lidar)
    array = as_floats(source, "poses")
    if array.ndim == 2 and array.shape[1] == 8:
        return _from_rows(array)
    if array.ndim != 3 or array.shape[1:] != (4, 4):
        raise DataError(f"poses: expected (N, 4, 4) or rows t_s, x, y, z, qx, qy, qz, qw; got {array.shape}")
    if known is None:
        raise DataError("poses (N, 4, 4) have no times: give stamps (N,), int64 nanoseconds")
    return Trajectory(np.asarray(known), array)


def _pose_file(path: Path, stamps: Stamps | None, T_camera_lidar: Array | None) -> Trajectory:
    if path.suffix == ".csv":
        return _euroc(path)
    if is_tum_file(path):
        return read_tum(path)
    if stamps is None:
        raise DataError(f"{path}: KITTI's format has no times; give stamps, such as times.txt")
    return read_kitti(path, stamps, T_camera_lidar)


def _euroc(path: Path) -> Trajectory:
    """Read EuRoC's ground-truth format, as evo does: ``stamp_ns, x, y, z, qw, qx, qy, qz`` and more, by commas."""
    try:
        lines = [line for line in path.read_text(encoding="utf-8").splitlines() if line and not line.startswith("#")]
        rows = [line.split(",")[:8] for line in lines]
        stamps = np.array([int(row[0]) for row in rows], np.int64)
        values = np.array([[float(number) for number in row[1:]] for row in rows]).reshape(-1, 7)
    except (OSError, ValueError) as error:
        raise DataError(
            f"{path}: expected rows stamp_ns, x, y, z, qw, qx, qy, qz as EuRoC has them ({error})"
        ) from None
    return _placed(stamps, values[:, :3], values[:, [4, 5, 6, 3]])


def _from_rows(rows: Array) -> Trajectory:
    return _placed(_nanoseconds(rows[:, 0]), rows[:, 1:4], rows[:, 4:])


def _placed(stamps: Stamps, positions: Array, quaternions: Array) -> Trajectory:
    if not np.isfinite(positions).all() or not np.linalg.norm(quaternions, axis=1).min(initial=1) > 0:
        raise DataError("poses: positions must be finite, and quaternions must not be zero")
    return Trajectory(stamps, se3.make(Rotation.from_quat(quaternions).as_matrix(), positions))


def _nanoseconds(seconds: Array) -> Stamps:
    return np.asarray(np.round(seconds * NS_PER_S), dtype=np.int64)


def _imu(source: Any, notes: list[str]) -> ImuSamples | None:
    """Return samples without those that a recorder drew as straight lines over gaps."""
    if source is None or (isinstance(source, ImuSamples) and not len(source)):
        return None
    if isinstance(source, str | os.PathLike):
        found = Notes(Path(source).name)
        samples = read_imu_csv(Path(source), found)
        notes.extend(found.texts)
    elif isinstance(source, ImuSamples):
        samples = source
    else:
        rows = _rows(source, 7, "imu", "t_s, gx, gy, gz, ax, ay, az")
        samples = ImuSamples(_nanoseconds(rows[:, 0]), rows[:, 1:4], rows[:, 4:])
    measured, gaps = without_filled_gaps(samples)
    if gaps:
        notes.append(f"IMU: left out the samples of {len(gaps)} gaps that straight lines fill")
    return measured


def fixes_of(source: Any, notes: list[str]) -> tuple[GpsFix, ...]:
    """Return fixes from a file, fixes, or rows, see :class:`OdometryInputs`; notes on a file are added to ``notes``."""
    if source is None:
        return ()
    if isinstance(source, str | os.PathLike):
        if not Path(source).is_file():
            raise DataError(f"{source}: no such file of GPS fixes")
        found = Notes(Path(source).name)
        fixes = read_gps_csv(Path(source), found)
        notes.extend(found.texts)
        return fixes
    if isinstance(source, Sequence) and all(isinstance(fix, GpsFix) for fix in source):
        return tuple(source)
    rows = _rows(source, 5, "fixes", "t_s, east, north, up, sigma_m")
    if not (rows[:, 4] > 0).all():
        raise DataError("fixes: standard deviations must be positive")
    stamps = _nanoseconds(rows[:, 0]).tolist()
    return tuple(GpsFix(t, row[1:4], row[4] ** 2 * np.eye(3)) for t, row in zip(stamps, rows, strict=True))


def _rows(source: Any, columns: int, name: str, meaning: str) -> Array:
    rows = as_floats(source, name)
    if rows.ndim != 2 or rows.shape[1] != columns or not np.isfinite(rows).all():
        raise DataError(f"{name}: expected finite rows {meaning}; got an array {rows.shape}")
    return rows


def _calibration(source: Any) -> StatedCalibration:
    if source is None or isinstance(source, Calibration):
        return StatedCalibration(source or Calibration())
    if not isinstance(source, str | os.PathLike) or not Path(source).is_file():
        raise DataError(f"{source}: no such calibration.yaml")
    return read_calibration_yaml(Path(source))
