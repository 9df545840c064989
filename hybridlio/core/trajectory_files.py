"""Trajectories as text: TUM's format (stamp, position, quaternion) and KITTI's (the upper three rows of a pose).

TUM: https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats. KITTI: the odometry benchmark's pose files.
Every complaint names the file and its row, counted from 1 as editors do.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.core.files import write_whole
from hybridlio.core.sensors import NS_PER_S
from hybridlio.core.trajectory import Trajectory

PathLike = str | os.PathLike[str]

KITTI_PERIOD_NS = NS_PER_S // 10
_COLUMNS = {8: "TUM (stamp x y z qx qy qz qw)", 12: "KITTI (three rows of a pose)"}
_ROTATION_TOLERANCE = 1e-2  # files of four decimals pass, anything that is no rotation does not


def write_tum(path: PathLike, trajectory: Trajectory) -> None:
    """Write ``stamp x y z qx qy qz qw`` rows: seconds with nine decimals (exact), metres and unit quaternions.

    Raises:
        DataError: the place cannot be written to.
    """
    quaternions = Rotation.from_matrix(trajectory.poses[:, :3, :3]).as_quat()
    values = np.hstack([trajectory.poses[:, :3, 3], quaternions])
    stamps = trajectory.stamps_ns.tolist()
    rows = (f"{_seconds(t)} {' '.join(f'{v:.12f}' for v in row)}\n" for t, row in zip(stamps, values, strict=True))
    write_whole(path, "# stamp_s x_m y_m z_m qx qy qz qw\n" + "".join(rows))


def read_tum(path: PathLike) -> Trajectory:
    """Read a TUM file; its stamps are taken to the nanosecond.

    Raises:
        DataError: unreadable, a row without eight finite numbers, no unit quaternion, or time that does not increase.
    """
    return _tum(Path(path), list(_rows(path)))


def write_kitti(path: PathLike, trajectory: Trajectory, T_camera_lidar: ArrayLike | None = None) -> None:
    """Write twelve numbers a row, the upper three rows of each pose; KITTI keeps the stamps elsewhere.

    Args:
        path: the file.
        trajectory: lidar poses.
        T_camera_lidar: ``(4, 4)``; with it the poses written are the camera's, ``T_camera_lidar·T·T_camera_lidar⁻¹``.

    Raises:
        DataError: the place cannot be written to.
    """
    poses = trajectory.poses if T_camera_lidar is None else _seen_from(T_camera_lidar, trajectory.poses)
    write_whole(path, "".join(" ".join(f"{v:.12f}" for v in row) + "\n" for row in poses[:, :3].reshape(-1, 12)))


def read_kitti(
    path: PathLike, stamps_ns: NDArray[np.int64] | None = None, T_camera_lidar: ArrayLike | None = None
) -> Trajectory:
    """Read a KITTI pose file.

    Args:
        path: the file.
        stamps_ns: ``(N,)``, one a row; without them rows are taken to be 0.1 s apart from 0, KITTI's nominal rate.
        T_camera_lidar: ``(4, 4)``; with it the file's poses are the camera's and the result is the lidar's.

    Raises:
        DataError: unreadable, a row without twelve finite numbers, no rotation, or not as many rows as stamps.
    """
    return _kitti(Path(path), list(_rows(path)), stamps_ns, T_camera_lidar)


def read_trajectory(
    path: PathLike, stamps_ns: NDArray[np.int64] | None = None, T_camera_lidar: ArrayLike | None = None
) -> Trajectory:
    """Read a TUM or KITTI file, told apart by the first row's columns; the arguments are :func:`read_kitti`'s.

    A TUM file keeps its own stamps and frame.

    Raises:
        DataError: what :func:`read_tum` and :func:`read_kitti` raise, or neither format's column count.
    """
    rows = list(_rows(path))
    if len(rows[0][1]) == 8:
        return _tum(Path(path), rows)
    if len(rows[0][1]) == 12:
        return _kitti(Path(path), rows, stamps_ns, T_camera_lidar)
    raise DataError(
        f"{path}: row {rows[0][0]} has {len(rows[0][1])} columns; expected one of {', '.join(_COLUMNS.values())}"
    )


def read_pair(reference_path: PathLike, estimate_path: PathLike) -> tuple[Trajectory, Trajectory]:
    """Reference and estimate to compare: where one file has no stamps (KITTI) its rows get the other's.

    Raises:
        DataError: what :func:`read_trajectory` raises, such as row counts that differ where stamps are lent.
    """
    reference, estimate = read_trajectory(reference_path), read_trajectory(estimate_path)
    stamped = [is_tum_file(path) for path in (reference_path, estimate_path)]
    if stamped == [False, True]:
        reference = read_kitti(reference_path, estimate.stamps_ns)
    if stamped == [True, False]:
        estimate = read_kitti(estimate_path, reference.stamps_ns)
    return reference, estimate


def is_tum_file(path: PathLike) -> bool:
    """Whether the first row has TUM's eight columns.

    Raises:
        DataError: unreadable, or no row in it.
    """
    return len(next(_rows(path))[1]) == 8


def _seconds(stamp_ns: int) -> str:
    sign, stamp_ns = "-" * (stamp_ns < 0), abs(stamp_ns)
    return f"{sign}{stamp_ns // NS_PER_S}.{stamp_ns % NS_PER_S:09d}"


def _seen_from(T_a_b: ArrayLike, poses_b: Array) -> Array:
    T = se3.check_pose(T_a_b, "T_camera_lidar")
    return np.asarray(T @ poses_b @ se3.inverse(T))


def _rows(path: PathLike) -> Iterator[tuple[int, list[str]]]:
    """Row numbers and fields of the lines that are neither empty nor comments; at least one."""
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError:
        raise DataError(f"{path}: not a text file; expected {' or '.join(_COLUMNS.values())}") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from error
    content = [
        (n, line.split()) for n, line in enumerate(lines, 1) if line.strip() and not line.lstrip().startswith("#")
    ]
    if not content:
        raise DataError(f"{path}: no poses in it")
    yield from content


def _numbers(path: Path, rows: list[tuple[int, list[str]]], columns: int) -> Array:
    """The rows as finite ``(N, columns)`` numbers."""
    out = np.empty((len(rows), columns))
    for values, (n, fields) in zip(out, rows, strict=True):
        if len(fields) != columns:
            raise DataError(f"{path}: row {n} has {len(fields)} columns; {_COLUMNS[columns]} has {columns}")
        try:
            values[:] = [float(field) for field in fields]
        except ValueError as error:
            raise DataError(f"{path}: row {n}: {error}") from None
        if not np.isfinite(values).all():
            raise DataError(f"{path}: row {n} holds a value that is not finite; drop or repair the row")
    return out


def _tum(path: Path, rows: list[tuple[int, list[str]]]) -> Trajectory:
    values = _numbers(path, rows, 8)
    norms = np.linalg.norm(values[:, 4:], axis=1)
    _complain_at(np.abs(norms - 1) > _ROTATION_TOLERANCE, path, rows, "its quaternion (qx qy qz qw) has not length 1")
    stamps = np.array([_nanoseconds(path, n, fields[0]) for n, fields in rows], np.int64)
    backwards = np.append(False, np.diff(stamps) <= 0)
    _complain_at(backwards, path, rows, "its stamp is not after the row before; sort the rows and drop repeated ones")
    return Trajectory(stamps, se3.make(Rotation.from_quat(values[:, 4:]).as_matrix(), values[:, 1:4]))


def _nanoseconds(path: Path, row: int, seconds: str) -> int:
    # not float: nanoseconds since 1970 do not fit its 53 bits
    try:
        ns = int((Decimal(seconds) * NS_PER_S).to_integral_value())
    except InvalidOperation:
        raise DataError(f"{path}: row {row}: stamp {seconds!r} is no number of seconds") from None
    if abs(ns) >= 2**63:
        raise DataError(f"{path}: row {row}: stamp {seconds} is beyond 292 years; TUM stamps are seconds")
    return ns


def _kitti(
    path: Path, rows: list[tuple[int, list[str]]], stamps_ns: NDArray[np.int64] | None, T_camera_lidar: ArrayLike | None
) -> Trajectory:
    upper = _numbers(path, rows, 12).reshape(-1, 3, 4)
    poses = se3.make(upper[:, :, :3], upper[:, :, 3])
    off = np.abs(se3.orthonormalise(poses) - poses).max(axis=(1, 2))
    _complain_at(off > _ROTATION_TOLERANCE, path, rows, "its first three columns are not a rotation")
    stamps = np.arange(len(rows), dtype=np.int64) * KITTI_PERIOD_NS if stamps_ns is None else stamps_ns
    if len(stamps) != len(rows):
        raise DataError(f"{path}: {len(rows)} poses, but {len(stamps)} stamps; each pose needs the stamp of its scan")
    if T_camera_lidar is not None:
        poses = _seen_from(se3.inverse(se3.check_pose(T_camera_lidar, "T_camera_lidar")), poses)
    return Trajectory(stamps, poses)


def _complain_at(bad: NDArray[np.bool_], path: Path, rows: list[tuple[int, list[str]]], what: str) -> None:
    if bad.any():
        raise DataError(f"{path}: row {rows[int(bad.argmax())][0]}: {what}")
