"""KITTI's navigation rows (OXTS): inertial samples, forward speed, and poses in a local Mercator plane.

The columns are those of the raw data's ``dataformat.txt``. The projection is that of KITTI's own ground truth (Geiger
et al., "Vision meets Robotics: The KITTI Dataset", IJRR 2013).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Stamps
from hybridlio.core.errors import DataError
from hybridlio.core.geodesy import EARTH_RADIUS_M
from hybridlio.core.sensors import NS_PER_S, ImuSamples
from hybridlio.datasets.kitti.files import numbered
from hybridlio.datasets.kitti.gyro_lag import SLOW_ROWS_S, gyro_lag_ns
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.stamps import IMU_GAP_FACTOR, MISSING_STAMP, note_gaps, read_stamps, sorted_unique

COLUMNS = 30  # of a navigation row, as KITTI's dataformat.txt lists them
_LAT, _LON, _ALT, _FORWARD = 0, 1, 2, 8  # latitude and longitude (degrees), altitude (m), forward speed (m/s)
_ATTITUDE, _ACCEL, _GYRO = slice(3, 6), slice(11, 14), slice(17, 20)  # roll pitch yaw; forward left up
_STANDING_M_S = 0.5  # below it a constant position is plausible: a vehicle that stands, with a noisy speed


@dataclass(frozen=True, eq=False)
class OxtsRows:
    """Navigation rows, strictly increasing in time.

    Attributes:
        stamps_ns: ``(R,)`` int64.
        values: ``(R, 30)`` in KITTI's units: degrees, metres, radians, m/s, m/s², rad/s. The inertial columns are
            finite. Positions, attitudes and speeds may be NaN, because a recording may lack them.
    """

    stamps_ns: Stamps
    values: Array

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def imu(self, gyro_lag_ns: int) -> ImuSamples:
        """Return the IMU samples in the body frame (forward, left, up), corrected for the lag of the angular rates.

        The angular rates of a row were measured ``gyro_lag_ns`` earlier, so they are shifted and interpolated linearly
        at the rows' stamps. Slow rows keep the samples of both sensors, at the stamps of both. The last angular rate is
        held for the duration of the lag. KITTI's specific forces lag by 10 to 20 ms at most and are not shifted.
        """
        stamps, shifted = self.stamps_ns, self.stamps_ns - gyro_lag_ns
        if len(self) > 1 and np.median(np.diff(stamps)) > SLOW_ROWS_S * NS_PER_S:
            stamps = np.union1d(stamps, shifted[shifted >= stamps[0]])
        at, accel_at, gyro_at = ((t - self.stamps_ns[0]) / NS_PER_S for t in (stamps, self.stamps_ns, shifted))
        gyro = [np.interp(at, gyro_at, column) for column in self.values[:, _GYRO].T]
        accel = [np.interp(at, accel_at, column) for column in self.values[:, _ACCEL].T]
        return ImuSamples(stamps, np.column_stack(gyro), np.column_stack(accel))

    @property
    def gyro_lag_ns(self) -> int:
        """Lag of the angular rates against the attitudes (:func:`hybridlio.datasets.kitti.gyro_lag.gyro_lag_ns`)."""
        known = np.isfinite(self.values[:, _ATTITUDE]).all(axis=1)
        values = self.values[known]
        return gyro_lag_ns(self.stamps_ns[known], values[:, _ATTITUDE], values[:, _GYRO])

    @property
    def T_enu_imu(self) -> Array:
        """Poses ``(R, 4, 4)`` in an east-north-up frame at the first row's position."""
        lat, lon = self.values[:, _LAT], self.values[:, _LON]
        scale_m = EARTH_RADIUS_M * np.cos(np.radians(lat[0]))
        east, north = scale_m * np.radians(lon), scale_m * np.log(np.tan(np.pi / 4 + np.radians(lat) / 2))
        position = np.column_stack([east, north, self.values[:, _ALT]])
        attitude = Rotation.from_euler("ZYX", self.values[:, _ATTITUDE][:, ::-1]).as_matrix()
        return se3.make(attitude, position - position[0])

    @property
    def with_positions(self) -> OxtsRows | None:
        """The rows with finite position and attitude; None if positions are NaN, 0, or constant while driving."""
        rows = np.isfinite(self.values[:, : _ATTITUDE.stop]).all(axis=1)
        values = self.values[rows]
        moves = np.ptp(values[:, :_ALT], axis=0).any() if len(values) else False
        stands = len(values) and values[:, :_ALT].any() and not (np.abs(values[:, _FORWARD]) > _STANDING_M_S).any()
        return OxtsRows(self.stamps_ns[rows], values) if moves or stands else None

    def forward_speed_at(self, stamps_ns: Stamps) -> Array | None:
        """Interpolate the forward speed ``(N,)`` in m/s, constant beyond the ends; None if the rows have no speeds."""
        speed = self.values[:, _FORWARD]
        known = np.isfinite(speed)
        if not known.any() or (self.with_positions is None and not speed[known].any()):
            return None
        at, seconds = ((t - self.stamps_ns[0]) / NS_PER_S for t in (stamps_ns, self.stamps_ns[known]))
        return np.asarray(np.interp(at, seconds, speed[known]))


def _read_row(path: Path) -> Array:
    try:
        values = np.array(path.read_text(encoding="utf-8").split(), dtype=np.float64)
    except (ValueError, UnicodeDecodeError):
        raise DataError(f"{path}: expected {COLUMNS} numbers, found other text; delete or repair the file") from None
    if len(values) != COLUMNS:
        raise DataError(f"{path}: expected {COLUMNS} columns, found {len(values)}; delete or repair the file")
    return values


def read_oxts(folder: Path, notes: Notes) -> OxtsRows:
    """Read the rows of an ``oxts`` folder (``timestamps.txt`` and ``data/NNNNNNNNNN.txt``), sorted by time.

    Rows are dropped whose stamp repeats, as in KITTI's unsynchronised recordings, or whose inertial columns are not
    finite. Both are noted, as are gaps.

    Raises:
        DataError: no rows, no finite row, a row with another number of columns, or a row without a stamp; the message
            names the file.
    """
    numbers, paths = numbered(folder / "data", ".txt")
    if not len(numbers):
        raise DataError(f"{folder / 'data'}: no navigation rows NNNNNNNNNN.txt")
    lines = read_stamps(folder / "timestamps.txt")
    if numbers[-1] >= len(lines) or (lines[numbers] == MISSING_STAMP).any():
        raise DataError(
            f"{folder / 'timestamps.txt'}: the {len(lines)} lines lack stamps of rows up to {paths[-1].name}"
        )
    values, stamps = np.array([_read_row(path) for path in paths]), lines[numbers]
    finite = np.isfinite(values[:, _ACCEL]).all(axis=1) & np.isfinite(values[:, _GYRO]).all(axis=1)
    if not finite.any():
        raise DataError(f"{folder}: no navigation row has finite inertial columns")
    if not finite.all():
        notes.add(
            f"{folder}: dropped {int((~finite).sum())} rows that are not finite, first {paths[finite.argmin()].name}"
        )
    values, stamps = values[finite], stamps[finite]
    order = sorted_unique(stamps, str(folder), notes)
    note_gaps(stamps[order], str(folder), notes, IMU_GAP_FACTOR)
    return OxtsRows(stamps[order], values[order])
