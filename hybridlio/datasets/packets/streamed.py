"""Scans that a library decodes one after another: read in order without going back, others from the start."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from hybridlio.core.arrays import Stamps
from hybridlio.core.errors import DataError, HybridLioError, strip_control
from hybridlio.core.sensors import Calibration, ImuSamples, Scan
from hybridlio.datasets.calibration_yaml import read_calibration_yaml
from hybridlio.datasets.imu_mounting import as_stated, note_mounting
from hybridlio.datasets.kitti.vertical_angle import raised
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.points.fields import Columns
from hybridlio.datasets.points.point_format import PointFormat, learn_format
from hybridlio.datasets.points.point_times import StatedTimes
from hybridlio.datasets.sequence import Sequence
from hybridlio.datasets.stamps import SCAN_GAP_FACTOR, note_coverage, note_gaps, usable_scans

Turns = Iterator[tuple[int, Columns]]


@contextmanager
def decoding(path: Path) -> Iterator[None]:
    """Turn any error of a vendor's library into one :class:`DataError` that names the file."""
    try:
        yield
    except HybridLioError:
        raise
    except Exception as error:
        reason = " ".join(strip_control(str(error)).split()) or type(error).__name__
        raise DataError(f"{path}: the packets cannot be decoded ({reason[:200]})") from None


@dataclass
class StreamedScans:
    """Loads scan ``k`` of a file of packets. Copies in other processes open the file again.

    Attributes:
        path: the file.
        turns: returns stamps and columns of all turns of the lidar, in order; must be picklable.
        stamps_ns: ``(N,)`` of the scans.
        rows: ``(N,)`` the position of each scan among the turns.
        format: how columns are read.
    """

    path: Path
    turns: Callable[[Path], Turns]
    stamps_ns: Stamps
    rows: Any
    format: PointFormat = field(default_factory=PointFormat)
    _at: int = 0
    _stream: Turns | None = None
    _lock: Any = field(default_factory=threading.Lock)

    def __call__(self, k: int) -> Scan:
        """Load scan ``k``; a :class:`DataError` names frame and file."""
        try:
            return self.format.scan(self.columns(k), int(self.stamps_ns[k]))
        except DataError as error:
            text = str(error).removeprefix(f"{self.path}: ")
            raise DataError(f"frame {k}: {self.path}: {text}") from None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_stream": None, "_lock": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _lock=threading.Lock())

    def columns(self, k: int) -> Columns:
        """Return the columns of scan ``k``.

        Raises:
            DataError: the packets cannot be decoded.
        """
        with self._lock, decoding(self.path):
            if self._stream is None or self._at > self.rows[k]:
                self._stream, self._at = self.turns(self.path), 0
            for _, columns in self._stream:
                self._at += 1
                if self._at > self.rows[k]:
                    return columns
            self._stream = None
            raise DataError(f"{self.path}: the packets end before this scan; the file has changed since it was opened")


def packet_sequence(
    path: Path,
    turns: Callable[[Path], Turns],
    times: StatedTimes,
    imu: ImuSamples,
    T_imu_lidar: Any,
    notes: Notes,
    vertical_angle_deg: float | None,
) -> Sequence:
    """Return the sequence of a file of packets; a ``calibration.yaml`` beside it comes first.

    Raises:
        DataError: there are no turns, or packets cannot be decoded.
        ConfigError: ``vertical_angle_deg`` is over 5°.
    """
    with decoding(path):
        stamps = np.array([stamp for stamp, _ in turns(path)], dtype=np.int64)
    if not len(stamps):
        raise DataError(f"{path}: no whole turn of a lidar in its packets")
    rows = usable_scans(stamps, path)
    if len(rows) < len(stamps):
        notes.add(f"dropped {len(stamps) - len(rows)} scans whose stamps repeat or go backwards")
    stamps = stamps[rows]
    note_gaps(stamps, "scans", notes, SCAN_GAP_FACTOR)
    stated = read_calibration_yaml(path.parent / "calibration.yaml")
    T = stated.calibration.T_imu_lidar if "T_imu_lidar" in stated.keys else T_imu_lidar
    if len(imu):
        imu = as_stated(imu, stated.imu_scale, stated.imu_time_offset_s, notes)
        note_mounting(imu, T, notes)
    note_coverage(imu.stamps_ns, stamps, "inertial data", notes)
    scans = StreamedScans(path, turns, stamps, rows)
    points = replace(stated.format, times=stated.format.times or times)
    scans.format = learn_format(stamps, scans.columns, notes, points)
    return Sequence(
        name=path.stem,
        stamps_ns=stamps,
        load_scan=raised(scans, vertical_angle_deg),
        imu=imu,
        calibration=Calibration(T, stated.calibration.T_camera_lidar, stated.calibration.antenna_imu_m),
        lidar=stated.lidar,
        imu_noise=stated.imu_noise,
        imu_time_offset_s=stated.imu_time_offset_s,
        imu_scale=stated.imu_scale,
        notes=tuple(notes.texts),
    )
