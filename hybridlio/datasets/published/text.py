"""Tables of numbers in text files: inertial samples and poses, whose first column is a time."""

from __future__ import annotations

from collections.abc import Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Stamps
from hybridlio.core.errors import DataError
from hybridlio.core.sensors import ImuSamples
from hybridlio.datasets.imu_csv import clean_imu
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.rosbag.transforms import MIN_NORM
from hybridlio.datasets.stamps import sorted_unique

US = 1000  # nanoseconds
_LARGEST_NS = 2**62  # far from the limit of int64


def read_table(path: Path, time: int | tuple[int, int], columns: Sequence[int]) -> tuple[list[str], Array]:
    """Read a text file of numbers, separated by commas or spaces, with or without a header.

    Args:
        path: the file.
        time: column of the time; for a pair of seconds and nanoseconds, both columns.
        columns: columns of the numbers to return.

    Returns:
        The times as written (a pair as decimal seconds), and the numbers ``(N, C)``.

    Raises:
        DataError: the file is missing or empty, or a row lacks a column or holds no numbers; the message names the
            line.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: cannot be read ({error})") from None
    times: list[str] = []
    rows: list[list[float]] = []
    for number, line in enumerate(lines, start=1):
        words = line.replace(",", " ").split()
        if not words or line.lstrip().startswith("#") or (not rows and not _is_number(words[0])):
            continue
        try:
            seconds, nanoseconds = (time, None) if isinstance(time, int) else time
            text = words[seconds] + ("" if nanoseconds is None else f".{int(words[nanoseconds]):09d}")
            rows.append([float(words[column]) for column in columns])
        except (ValueError, IndexError):
            raise DataError(f"{path}, line {number}: expected numbers, found {line.strip()[:80]!r}") from None
        times.append(text)
    if not rows:
        raise DataError(f"{path}: no rows of numbers")
    return times, np.array(rows, dtype=np.float64)


def stamps_of(path: Path, times: Sequence[str], unit_ns: int) -> Stamps:
    """Return times, written as integers or decimals in a unit, in int64 nanoseconds, exactly.

    Raises:
        DataError: a time is no number, or beyond the range of int64; the message names ``path``.
    """
    stamps = []
    for text in times:
        try:
            value = round(Decimal(text) * unit_ns)
        except (InvalidOperation, ValueError, OverflowError):
            raise DataError(f"{path}: cannot read {text[:40]!r} as a time") from None
        if abs(value) > _LARGEST_NS:
            raise DataError(f"{path}: the time {text[:40]} is beyond the range of int64 nanoseconds")
        stamps.append(value)
    return np.array(stamps, dtype=np.int64)


def stamps_of_names(paths: Sequence[Path], unit_ns: int) -> Stamps:
    """Return the stamps that the names of files state, as whole numbers of a unit."""
    names = [path.name.partition(".")[0] for path in paths]
    return stamps_of(paths[0].parent, names, unit_ns) if paths else np.empty(0, np.int64)


def numbered_files(folder: Path, suffix: str) -> tuple[Path, ...]:
    """Return the files of a folder whose name is a whole number and a suffix, in order of the number."""
    found = [path for path in folder.glob(f"*{suffix}") if path.name.removesuffix(suffix).isdecimal()]
    return tuple(sorted(found, key=lambda path: int(path.name.removesuffix(suffix))))


def read_imu(
    path: Path, notes: Notes, unit_ns: int, gyro: Sequence[int], accel: Sequence[int], time: int = 0
) -> ImuSamples:
    """Read samples from a table of angular velocities (rad/s) and specific forces (m/s²); corrections are noted.

    Raises:
        DataError: the table is malformed, or no row is finite.
    """
    times, values = read_table(path, time, [*gyro, *accel])
    return clean_imu(str(path), stamps_of(path, times, unit_ns), values, notes)


def read_xsens(path: Path, notes: Notes) -> ImuSamples:
    """Read the IMU file of MulRan and HeLiPR, with the columns of their file players.

    They are nanoseconds, quaternion, three angles, angular velocity, specific force, and magnetic field.

    Raises:
        DataError: the table is malformed, or no row is finite.
    """
    return read_imu(path, notes, 1, (8, 9, 10), (11, 12, 13))


def read_poses(
    path: Path, notes: Notes, unit_ns: int, time: int | tuple[int, int] = 0, first: int = 1
) -> tuple[Stamps, Array]:
    """Read poses from a table of a time, a position and a quaternion x y z w, sorted by time.

    Args:
        path: the file.
        notes: receives what is corrected.
        unit_ns: nanoseconds of one unit of the time.
        time: as in :func:`read_table`.
        first: column of the position's x.

    Raises:
        DataError: the table is malformed, or a quaternion is zero.
    """
    times, values = read_table(path, time, range(first, first + 7))
    poses = poses_of(values[:, :3], values[:, 3:], str(path))
    return in_order(stamps_of(path, times, unit_ns), poses, str(path), notes)


def poses_of(positions: Array, quaternions_xyzw: Array, what: str) -> Array:
    """Return poses ``(N, 4, 4)`` from positions ``(N, 3)`` and quaternions ``(N, 4)``.

    Raises:
        DataError: a number is not finite, or a quaternion is zero.
    """
    largest = np.abs(quaternions_xyzw).max(axis=1, initial=0)
    finite = np.isfinite(positions).all() and np.isfinite(quaternions_xyzw).all()
    if not finite or not ((largest > MIN_NORM) & (largest < 1 / MIN_NORM)).all():
        raise DataError(f"{what}: expected finite numbers and quaternions that are not zero")
    return se3.make(Rotation.from_quat(quaternions_xyzw).as_matrix(), positions)


def read_matrices(path: Path, notes: Notes, unit_ns: int) -> tuple[Stamps, Array]:
    """Read poses from a table of a time and the twelve numbers of three rows, sorted by time.

    Raises:
        DataError: the table is malformed, or a pose is not rigid.
    """
    times, values = read_table(path, 0, range(1, 13))
    poses = np.tile(np.eye(4), (len(values), 1, 1))
    poses[:, :3] = values.reshape(-1, 3, 4)
    for row, pose in enumerate(poses):
        se3.check_pose(pose, f"{path}: pose {row}")
    return in_order(stamps_of(path, times, unit_ns), poses, str(path), notes)


def in_order(stamps: Stamps, poses: Array, what: str, notes: Notes) -> tuple[Stamps, Array]:
    """Return stamps and poses sorted by time, the first of equal stamps; corrections are noted."""
    order = sorted_unique(stamps, what, notes)
    return stamps[order], poses[order]


def read_transform(path: Path) -> Array:
    """Read a transform of three or four rows of four numbers.

    Raises:
        DataError: the file is missing, has other numbers, or the transform is not rigid.
    """
    try:
        numbers = np.array(path.read_text(encoding="utf-8").replace(",", " ").split(), dtype=np.float64)
    except (OSError, ValueError):
        numbers = np.empty(0)
    if numbers.size not in (12, 16):
        raise DataError(f"{path}: expected a transform, three or four rows of four numbers")
    return se3.check_pose(np.vstack([numbers.reshape(-1, 4)[:3], [0, 0, 0, 1]]), str(path))


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
