"""KITTI's file formats: calibrations, and scans as float32 x y z reflectance."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.core.sensors import Scan


def read_calibration(path: Path) -> dict[str, Array]:
    """The numeric ``name: values`` rows of a KITTI calibration file; other rows (dates) are left out.

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
    """The rows ``names`` of a calibration: of 12 numbers as ``(3, 4)``, of 9 as ``(3, 3)``, of 3 as ``(3,)``.

    Raises:
        DataError: a row is missing, has another number of values, or is not finite.
    """
    found = []
    for name in names:
        values = calibration.get(name, np.empty(0))
        if len(values) not in (3, 9, 12) or not np.isfinite(values).all():
            raise DataError(f"{path}: expected a row '{name}:' with 3, 9 or 12 numbers, found {len(values)}")
        found.append(values.reshape(3, -1) if len(values) > 3 else values)
    return tuple(found)


def read_rigid(path: Path) -> Array:
    """The transform ``(4, 4)`` of a raw-data calibration file with rows ``R:`` and ``T:``."""
    R, t = rows_of(read_calibration(path), path, "R", "T")
    if R.shape != (3, 3) or t.shape != (3,):
        raise DataError(f"{path}: expected 9 numbers in 'R:' and 3 in 'T:', found {R.size} and {t.size}")
    return se3.check_pose(se3.make(R, t), str(path))


def numbered(folder: Path, suffix: str) -> tuple[NDArray[np.int64], tuple[Path, ...]]:
    """The files of ``folder`` named by a number, in that number's order: the numbers ``(N,)`` and the paths."""
    found = sorted((int(p.stem), p) for p in folder.glob(f"*{suffix}") if p.stem.isdigit()) if folder.is_dir() else []
    return np.array([number for number, _ in found], dtype=np.int64), tuple(path for _, path in found)


def read_bin(path: Path) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Points ``(N, 3)`` in metres and reflectances ``(N,)`` of a ``.bin`` scan.

    Raises:
        DataError: the file is missing, empty, or no whole number of points long, as after an interrupted copy.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DataError(f"{path}: cannot read the scan ({error.strerror})") from None
    if not data:
        raise DataError(f"{path}: the scan has no points (0 bytes)")
    if len(data) % 16:
        raise DataError(f"{path}: truncated scan, {len(data)} bytes is no multiple of 16 (x y z reflectance, float32)")
    values = np.frombuffer(data, dtype="<f4").reshape(-1, 4)
    return values[:, :3], values[:, 3]


@dataclass(frozen=True)
class BinScans:
    """Loads scan ``k`` from ``paths[k]``; an object rather than a closure, so that it can go to another process.

    Attributes:
        paths: one ``.bin`` file a scan.
        stamps_ns: one stamp a scan.
        offsets: a folder with each point's time offset, ``<scan's name>.npy`` of int64 nanoseconds, or None.
    """

    paths: tuple[Path, ...]
    stamps_ns: NDArray[np.int64]
    offsets: Path | None = None

    def __call__(self, k: int) -> Scan:
        """Scan ``k``.

        Raises:
            DataError: the file is missing, truncated, or without a finite point; names the frame and the file.
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

    def _offsets_ns(self, scan: Path) -> NDArray[np.int64] | None:
        if self.offsets is None:
            return None
        path = self.offsets / f"{scan.stem}.npy"
        try:
            return np.asarray(np.load(path, allow_pickle=False), dtype=np.int64)
        except (OSError, ValueError, EOFError) as error:
            raise DataError(f"{path}: cannot read the points' time offsets ({error})") from None
