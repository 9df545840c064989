"""KITTI's navigation rows (OXTS): inertial samples, forward speed, and poses in a local Mercator plane.

The columns are those of the raw data's ``dataformat.txt``; the projection is the one KITTI's own ground truth uses
(Geiger et al., "Vision meets Robotics: The KITTI Dataset", IJRR 2013).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.core.geodesy import EARTH_RADIUS_M
from hybridlio.core.sensors import ImuSamples
from hybridlio.core.trajectory import Trajectory
from hybridlio.datasets.gyro_lag import gyro_lag_ns
from hybridlio.datasets.kitti_files import numbered
from hybridlio.datasets.reference import poses_at
from hybridlio.datasets.sequence import Notes
from hybridlio.datasets.stamps import MISSING_STAMP, note_gaps, read_stamps, sorted_unique

COLUMNS = 30
_LAT, _LON, _ALT, _FORWARD = 0, 1, 2, 8
_ATTITUDE, _ACCEL, _GYRO = slice(3, 6), slice(11, 14), slice(17, 20)  # roll pitch yaw; forward left up
_SLOW_NS = 20_000_000


@dataclass(frozen=True, eq=False)
class OxtsRows:
    """Navigation rows, strictly increasing in time.

    Attributes:
        stamps_ns: ``(R,)`` int64.
        values: ``(R, 30)`` in KITTI's units: degrees, metres, radians, m/s, m/s², rad/s. The inertial columns are
            finite; positions, attitudes and speeds need not be, as a recording may do without them.
    """

    stamps_ns: NDArray[np.int64]
    values: Array

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def imu(self, gyro_lag_ns: int) -> ImuSamples:
        """Angular velocity and specific force along the body's axes (forward, left, up), both at their own times.

        The angular velocities of a row are those of ``gyro_lag_ns`` before, so they are moved there by linear
        interpolation. Slow rows keep the samples of both, at the stamps of both; the last angular velocity is held for
        as long as the lag. KITTI's specific forces are late by 10 to 20 ms at most and stay.
        """
        stamps, moved = self.stamps_ns, self.stamps_ns - gyro_lag_ns
        if len(self) > 1 and np.median(np.diff(stamps)) > _SLOW_NS:
            stamps = np.union1d(stamps, moved[moved >= stamps[0]])
        at, accel_at, gyro_at = ((t - self.stamps_ns[0]) / 1e9 for t in (stamps, self.stamps_ns, moved))
        gyro = [np.interp(at, gyro_at, column) for column in self.values[:, _GYRO].T]
        accel = [np.interp(at, accel_at, column) for column in self.values[:, _ACCEL].T]
        return ImuSamples(stamps, np.column_stack(gyro), np.column_stack(accel))

    @property
    def gyro_lag_ns(self) -> int:
        """By how much the angular velocities are late, see :func:`hybridlio.datasets.gyro_lag.gyro_lag_ns`."""
        known = np.isfinite(self.values[:, _ATTITUDE]).all(axis=1)
        values = self.values[known]
        return gyro_lag_ns(self.stamps_ns[known], values[:, _ATTITUDE], values[:, _GYRO])

    @property
    def T_enu_imu(self) -> Array:
        """Poses ``(R, 4, 4)``, east-north-up with its origin at the first row's position."""
        lat, lon = self.values[:, _LAT], self.values[:, _LON]
        scale_m = EARTH_RADIUS_M * np.cos(np.radians(lat[0]))
        east, north = scale_m * np.radians(lon), scale_m * np.log(np.tan(np.pi / 4 + np.radians(lat) / 2))
        position = np.column_stack([east, north, self.values[:, _ALT]])
        attitude = Rotation.from_euler("ZYX", self.values[:, _ATTITUDE][:, ::-1]).as_matrix()
        return se3.make(attitude, position - position[0])

    @property
    def placed(self) -> OxtsRows | None:
        """The rows with position and attitude; None where positions are not given: absent, 0, or still in a drive."""
        rows = np.isfinite(self.values[:, : _ATTITUDE.stop]).all(axis=1)
        values = self.values[rows]
        moves = np.ptp(values[:, :_ALT], axis=0).any() if len(values) else False
        stands = len(values) and values[:, :_ALT].any() and not (np.abs(values[:, _FORWARD]) > 0.5).any()
        return OxtsRows(self.stamps_ns[rows], values) if moves or stands else None

    def forward_speed_at(self, stamps_ns: NDArray[np.int64]) -> Array | None:
        """Forward speed ``(N,)`` in m/s at ``stamps_ns``, interpolated, constant beyond the ends; None if not given."""
        speed = self.values[:, _FORWARD]
        known = np.isfinite(speed)
        if not known.any() or (self.placed is None and not speed[known].any()):
            return None
        at, seconds = ((t - self.stamps_ns[0]) / 1e9 for t in (stamps_ns, self.stamps_ns[known]))
        return np.asarray(np.interp(at, seconds, speed[known]))

    def lidar_poses_at(self, stamps_ns: NDArray[np.int64], T_imu_lidar: Array, notes: Notes) -> Trajectory | None:
        """Lidar poses at ``stamps_ns`` in the frame of the first.

        None, with a note, where the rows do not reach or positions are not given.
        """
        placed = self.placed
        if placed is None:
            notes.add("no reference poses: the navigation rows give no positions")
            return None
        return poses_at(stamps_ns, placed.stamps_ns, placed.T_enu_imu @ T_imu_lidar, "navigation rows", notes)


def _read_row(path: Path) -> Array:
    try:
        values = np.array(path.read_text(encoding="utf-8").split(), dtype=np.float64)
    except (ValueError, UnicodeDecodeError):
        raise DataError(f"{path}: expected {COLUMNS} numbers, found something else; delete or repair it") from None
    if len(values) != COLUMNS:
        raise DataError(f"{path}: expected {COLUMNS} columns, found {len(values)}; delete the row's file or repair it")
    return values


def read_oxts(folder: Path, notes: Notes) -> OxtsRows:
    """The rows of an ``oxts`` folder (``timestamps.txt`` and ``data/NNNNNNNNNN.txt``), in order of time.

    Stamps that repeat or go backwards (as in KITTI's unsynchronised recordings) are sorted and made unique, rows whose
    inertial columns are not finite are dropped; both are noted.

    Raises:
        DataError: no rows, a row with another number of columns, or a row without a stamp; names the file.
    """
    numbers, paths = numbered(folder / "data", ".txt")
    if not len(numbers):
        raise DataError(f"{folder / 'data'}: no navigation rows NNNNNNNNNN.txt")
    lines = read_stamps(folder / "timestamps.txt")
    if numbers[-1] >= len(lines) or (lines[numbers] == MISSING_STAMP).any():
        raise DataError(
            f"{folder / 'timestamps.txt'}: {len(lines)} lines do not stamp every row up to {paths[-1].name}"
        )
    values, stamps = np.array([_read_row(path) for path in paths]), lines[numbers]
    finite = np.isfinite(values[:, _ACCEL]).all(axis=1) & np.isfinite(values[:, _GYRO]).all(axis=1)
    if not finite.any():
        raise DataError(f"{folder}: no navigation row is finite")
    if not finite.all():
        notes.add(
            f"{folder}: dropped {int((~finite).sum())} rows that are not finite, first {paths[finite.argmin()].name}"
        )
    values, stamps = values[finite], stamps[finite]
    order = sorted_unique(stamps, str(folder), notes)
    note_gaps(stamps[order], str(folder), notes, factor=5.0)
    return OxtsRows(stamps[order], values[order])
