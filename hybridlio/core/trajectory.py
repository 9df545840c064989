"""A trajectory, stamped lidar poses with covariances, and its files.

TUM's format: stamp, position, quaternion (https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats). KITTI's: the
upper three rows of each pose (pose files of the odometry benchmark). Errors name the file and the row, counted from 1.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from hybridlio.core import se3
from hybridlio.core.arrays import NS_PER_S, Array, Mask, Stamps
from hybridlio.core.errors import ConfigError, DataError
from hybridlio.core.files import write_atomically

PathLike = str | os.PathLike[str]

KITTI_PERIOD_NS = NS_PER_S // 10  # nominal: the HDL-64E turns at 10 Hz
# formats by the number of columns in a row
_COLUMNS = {8: "TUM (stamp x y z qx qy qz qw)", 12: "KITTI (three rows of a pose)"}
_LARGEST = 1e100  # of any number, so that squares stay finite
_ROTATION_TOLERANCE = 1e-2  # passes files with two or more decimals, rejects anything that is no rotation


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses over time.

    Attributes:
        stamps_ns: ``(N,)`` int64, strictly increasing.
        poses: ``(N, 4, 4)`` ``T_world_lidar``; world is the lidar frame of the first scan unless stated otherwise.
        covariances: ``(N, 6, 6)`` of right perturbations, rad² and m², rotation first; None if unknown.

    Raises:
        DataError: a shape is wrong, a pose is not finite, or time does not increase.
    """

    stamps_ns: Stamps
    poses: Array
    covariances: Array | None = None

    def __post_init__(self) -> None:
        stamps = np.asarray(self.stamps_ns, dtype=np.int64)
        poses = np.asarray(self.poses, dtype=np.float64)
        if poses.shape != (len(stamps), 4, 4) or not np.isfinite(poses).all():
            raise DataError(f"trajectory: expected finite ({len(stamps)}, 4, 4) poses, got shape {poses.shape}")
        backwards = np.diff(stamps) <= 0
        if backwards.any():
            raise DataError(f"trajectory: time does not increase at row {int(backwards.argmax()) + 1}")
        if self.covariances is not None and np.shape(self.covariances) != (len(stamps), 6, 6):
            raise DataError(f"trajectory: covariances must be ({len(stamps)}, 6, 6), got {np.shape(self.covariances)}")
        object.__setattr__(self, "stamps_ns", stamps)
        object.__setattr__(self, "poses", se3.orthonormalise(poses))

    def __repr__(self) -> str:
        if not len(self):
            return "Trajectory(0 poses)"
        covariances = "" if self.covariances is None else ", with covariances"
        return f"Trajectory({len(self)} poses, {self.times_s[-1]:.1f} s, {self.length_m:.1f} m{covariances})"

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def times_s(self) -> Array:
        """Seconds ``(N,)`` since the first pose."""
        return np.asarray((self.stamps_ns - self.stamps_ns[0]) / 1e9)

    @property
    def length_m(self) -> float:
        """Path length in metres."""
        return float(np.linalg.norm(np.diff(self.poses[:, :3, 3], axis=0), axis=1).sum())

    @classmethod
    def load(
        cls, path: PathLike, stamps_ns: Stamps | None = None, T_camera_lidar: ArrayLike | None = None
    ) -> Trajectory:
        """Read a TUM or KITTI file; see :func:`read_trajectory`, also for errors."""
        return read_trajectory(path, stamps_ns, T_camera_lidar)

    def save(self, path: PathLike, format: Literal["tum", "kitti"] = "tum") -> None:
        """Write the poses as a TUM file, with stamps, or as a KITTI file without; neither holds covariances.

        Raises:
            ConfigError: the format is unknown.
            DataError: the place cannot be written to.
        """
        if format not in ("tum", "kitti"):
            raise ConfigError(f"unknown format {format!r} of a trajectory file; choose tum or kitti")
        (write_tum if format == "tum" else write_kitti)(path, self)

    def from_first(self) -> Trajectory:
        """Return the same poses in the frame of the first one."""
        return Trajectory(self.stamps_ns, se3.between(self.poses[0], self.poses), self.covariances)


def travelled_m(positions_m: Array) -> Array:
    """Return the path length ``(N,)`` from the first position to each of ``(N, 3)`` positions."""
    return np.append(0.0, np.cumsum(np.linalg.norm(np.diff(positions_m, axis=0), axis=1)))


def write_tum(path: PathLike, trajectory: Trajectory) -> None:
    """Write ``stamp x y z qx qy qz qw`` rows: seconds with nine decimals (exact), metres and unit quaternions.

    Raises:
        DataError: the place cannot be written to.
    """
    quaternions = Rotation.from_matrix(trajectory.poses[:, :3, :3]).as_quat()
    values = np.hstack([trajectory.poses[:, :3, 3], quaternions])
    stamps = trajectory.stamps_ns.tolist()
    rows = (f"{_format_stamp(t)} {' '.join(f'{v:.12f}' for v in row)}\n" for t, row in zip(stamps, values, strict=True))
    write_atomically(path, "# stamp_s x_m y_m z_m qx qy qz qw\n" + "".join(rows))


def read_tum(path: PathLike) -> Trajectory:
    """Read a TUM file; stamps keep every nanosecond.

    Raises:
        DataError: unreadable, a row without eight finite numbers, a quaternion not of length 1, or time not increasing.
    """
    return _parse_tum(Path(path), list(_rows(path)))


def write_kitti(path: PathLike, trajectory: Trajectory, T_camera_lidar: ArrayLike | None = None) -> None:
    """Write the upper three rows of each pose, twelve numbers a line. The format has no stamps.

    Args:
        path: the file.
        trajectory: lidar poses.
        T_camera_lidar: ``(4, 4)``; if given, camera poses ``T_camera_lidar·T·T_camera_lidar⁻¹`` are written.

    Raises:
        DataError: the place cannot be written to.
    """
    poses = trajectory.poses if T_camera_lidar is None else _to_frame(T_camera_lidar, trajectory.poses)
    write_atomically(path, "".join(" ".join(f"{v:.12f}" for v in row) + "\n" for row in poses[:, :3].reshape(-1, 12)))


def read_kitti(path: PathLike, stamps_ns: Stamps | None = None, T_camera_lidar: ArrayLike | None = None) -> Trajectory:
    """Read a KITTI pose file.

    Args:
        path: the file.
        stamps_ns: ``(N,)``, one per row; by default 0, 0.1 s, 0.2 s … at KITTI's nominal rate.
        T_camera_lidar: ``(4, 4)``; if given, the file holds camera poses, and lidar poses are returned.

    Raises:
        DataError: unreadable, a row without twelve finite numbers, no rotation, or not one stamp per row.
    """
    return _parse_kitti(Path(path), list(_rows(path)), stamps_ns, T_camera_lidar)


def read_trajectory(
    path: PathLike, stamps_ns: Stamps | None = None, T_camera_lidar: ArrayLike | None = None
) -> Trajectory:
    """Read a TUM or a KITTI file, distinguished by the number of columns.

    The arguments are those of :func:`read_kitti`. A TUM file keeps its own stamps and frame.

    Raises:
        DataError: as :func:`read_tum` and :func:`read_kitti`, or the first row has neither 8 nor 12 columns.
    """
    rows = list(_rows(path))
    if len(rows[0][1]) == 8:
        return _parse_tum(Path(path), rows)
    if len(rows[0][1]) == 12:
        return _parse_kitti(Path(path), rows, stamps_ns, T_camera_lidar)
    raise DataError(
        f"{path}: row {rows[0][0]} has {len(rows[0][1])} columns; expected one of {', '.join(_COLUMNS.values())}"
    )


def read_pair(estimate_path: PathLike, reference_path: PathLike) -> tuple[Trajectory, Trajectory]:
    """Read estimate and reference for a comparison. If one file has no stamps (KITTI), it gets those of the other.

    Raises:
        DataError: as :func:`read_trajectory`, such as another number of rows than of the stamps taken over.
    """
    estimate, reference = read_trajectory(estimate_path), read_trajectory(reference_path)
    stamped = [is_tum_file(path) for path in (estimate_path, reference_path)]
    if stamped == [True, False]:
        reference = read_kitti(reference_path, estimate.stamps_ns)
    if stamped == [False, True]:
        estimate = read_kitti(estimate_path, reference.stamps_ns)
    return estimate, reference


def is_tum_file(path: PathLike) -> bool:
    """Return whether the first row has the eight columns of TUM's format.

    Raises:
        DataError: unreadable or empty.
    """
    return len(next(_rows(path))[1]) == 8


def _format_stamp(stamp_ns: int) -> str:
    sign, stamp_ns = "-" * (stamp_ns < 0), abs(stamp_ns)
    return f"{sign}{stamp_ns // NS_PER_S}.{stamp_ns % NS_PER_S:09d}"


def _to_frame(T_a_b: ArrayLike, poses_b: Array) -> Array:
    T = se3.check_pose(T_a_b, "T_camera_lidar")
    return np.asarray(T @ poses_b @ se3.inverse(T))


def _rows(path: PathLike) -> Iterator[tuple[int, list[str]]]:
    """Yield number and fields of each line that is neither empty nor a comment; at least one."""
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
        raise DataError(f"{path}: contains no poses")
    yield from content


def _parse_numbers(path: Path, rows: list[tuple[int, list[str]]], columns: int) -> Array:
    """Convert the rows to finite numbers ``(N, columns)``."""
    out = np.empty((len(rows), columns))
    for values, (n, fields) in zip(out, rows, strict=True):
        if len(fields) != columns:
            raise DataError(f"{path}: row {n} has {len(fields)} columns; {_COLUMNS[columns]} has {columns}")
        try:
            values[:] = [float(field) for field in fields]
        except ValueError as error:
            raise DataError(f"{path}: row {n}: {error}") from None
        if not (np.abs(values) < _LARGEST).all():
            raise DataError(f"{path}: row {n} contains a value that is not finite, or too large; repair the row")
    return out


def _parse_tum(path: Path, rows: list[tuple[int, list[str]]]) -> Trajectory:
    values = _parse_numbers(path, rows, 8)
    norms = np.linalg.norm(values[:, 4:], axis=1)
    _raise_at(np.abs(norms - 1) > _ROTATION_TOLERANCE, path, rows, "the length of the quaternion qx qy qz qw is not 1")
    stamps = np.array([_parse_stamp(path, n, fields[0]) for n, fields in rows], np.int64)
    backwards = np.append(False, np.diff(stamps) <= 0)
    _raise_at(backwards, path, rows, "the stamp is not after the row before; sort the rows and remove duplicates")
    return Trajectory(stamps, se3.make(Rotation.from_quat(values[:, 4:]).as_matrix(), values[:, 1:4]))


def _parse_stamp(path: Path, row: int, seconds: str) -> int:
    # not via float, whose 53 bits do not hold nanoseconds since 1970
    try:
        ns = int((Decimal(seconds) * NS_PER_S).to_integral_value())
    except InvalidOperation:
        raise DataError(f"{path}: row {row}: stamp {seconds!r} is not a number of seconds") from None
    if abs(ns) >= 2**63:
        raise DataError(f"{path}: row {row}: stamp {seconds} is beyond 292 years; stamps in TUM files are seconds")
    return ns


def _parse_kitti(
    path: Path, rows: list[tuple[int, list[str]]], stamps_ns: Stamps | None, T_camera_lidar: ArrayLike | None
) -> Trajectory:
    upper = _parse_numbers(path, rows, 12).reshape(-1, 3, 4)
    poses = se3.make(upper[:, :, :3], upper[:, :, 3])
    off = np.abs(se3.orthonormalise(poses) - poses).max(axis=(1, 2))
    _raise_at(off > _ROTATION_TOLERANCE, path, rows, "the first three columns of the pose are not a rotation")
    stamps = np.arange(len(rows), dtype=np.int64) * KITTI_PERIOD_NS if stamps_ns is None else stamps_ns
    if len(stamps) != len(rows):
        raise DataError(f"{path}: {len(rows)} poses, but {len(stamps)} stamps; there must be one for each pose")
    if T_camera_lidar is not None:
        poses = _to_frame(se3.inverse(se3.check_pose(T_camera_lidar, "T_camera_lidar")), poses)
    return Trajectory(stamps, poses)


def _raise_at(bad: Mask, path: Path, rows: list[tuple[int, list[str]]], what: str) -> None:
    if bad.any():
        raise DataError(f"{path}: row {rows[int(bad.argmax())][0]}: {what}")
