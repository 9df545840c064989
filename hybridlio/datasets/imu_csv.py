"""IMU samples from a CSV file, whose header names the columns and optionally their units."""

from __future__ import annotations

from decimal import InvalidOperation
from pathlib import Path

import numpy as np

from hybridlio.core.arrays import Array, Stamps
from hybridlio.core.errors import DataError
from hybridlio.core.sensors import ImuSamples
from hybridlio.datasets.csv_rows import read_csv
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.stamps import IMU_GAP_FACTOR, note_gaps, seconds_ns, sorted_unique

_STANDARD_GRAVITY_M_S2 = 9.80665  # the unit g, by definition; not the gravity of a place
_PLAUSIBLE_FORCE_M_S2 = (5.0, 20.0)  # of the median: half to twice gravity; values in g (1) or mm/s² (9810) are outside
_MAX_RATE_RAD_S = 6.0  # 95 % quantile; a turn per second is beyond vehicles and hands, but 6 °/s taken for rad/s is not
_UNITS = {
    "g": {"": 1.0, "_rad_s": 1.0, "_deg_s": np.pi / 180},
    "a": {"": 1.0, "_m_s2": 1.0, "_g": _STANDARD_GRAVITY_M_S2},
}
_EXPECTED = "stamp_ns (or t_s), gx gy gz (rad/s; or gx_deg_s …), ax ay az (m/s²; or ax_g …)"


def read_imu_csv(path: Path, notes: Notes) -> ImuSamples:
    """Read IMU samples from a CSV file, sorted by time.

    Columns, in any order; others are ignored:

    * ``stamp_ns`` (whole nanoseconds) or ``t_s`` (seconds), on the scans' clock;
    * angular velocity in the IMU frame: ``gx gy gz`` in rad/s, or ``gx_deg_s gy_deg_s gz_deg_s``;
    * specific force in the IMU frame (+9.81 at rest on the axis that points up): ``ax ay az`` in m/s², or ``ax_g …``.

    Repeated stamps and rows that are not finite are dropped. Both are noted, as are gaps and implausible units.

    Raises:
        DataError: a column is missing, a row is malformed, or no row is finite; the message names file and line.
    """
    header, rows = read_csv(path)
    time_column, columns = _columns(path, header)
    stamps = np.empty(len(rows), dtype=np.int64)
    values = np.empty((len(rows), 6))
    for k, (line, row) in enumerate(rows):
        try:
            stamps[k] = _stamp_ns(row[time_column], header[time_column])
            values[k] = [float(row[column]) * scale for column, scale in columns]
        except (ValueError, InvalidOperation, OverflowError):
            raise DataError(f"{path}, line {line}: expected numbers, found {','.join(row)[:80]}") from None
    return clean_imu(str(path), stamps, values, notes)


def _columns(path: Path, header: list[str]) -> tuple[int, list[tuple[int, float]]]:
    """Return the column of the time, and for gx gy gz ax ay az the column and the factor to rad/s or m/s²."""
    times = [header.index(name) for name in ("stamp_ns", "t_s") if name in header]
    found = []
    for kind, axis in ((kind, axis) for kind in "ga" for axis in "xyz"):
        names = {kind + axis + unit: scale for unit, scale in _UNITS[kind].items()}
        found += [(header.index(name), scale) for name, scale in names.items() if name in header][:1]
    if not times or len(found) != 6:
        raise DataError(f"{path}: the header must name {_EXPECTED}; found: {', '.join(header) or 'nothing'}")
    return times[0], found


def _stamp_ns(text: str, name: str) -> int:
    return int(text) if name == "stamp_ns" else seconds_ns(text.strip())


def clean_imu(source: str, stamps: Stamps, values: Array, notes: Notes) -> ImuSamples:
    """Sort samples, drop those that repeat or are not finite, and note gaps and what looks like a wrong unit.

    Args:
        source: the file or topic, for messages.
        stamps: ``(S,)`` int64 nanoseconds.
        values: ``(S, 6)`` angular velocity in rad/s and specific force in m/s².
        notes: receives the notes.

    Raises:
        DataError: no sample is finite.
    """
    finite = np.isfinite(values).all(axis=1)
    if not finite.any():
        raise DataError(f"{source}: no row of finite values")
    if not finite.all():
        notes.add(
            f"{source}: dropped {int((~finite).sum())} rows that are not finite, first row {int(finite.argmin())}"
        )
    stamps, values = stamps[finite], values[finite]
    order = sorted_unique(stamps, source, notes)
    stamps, values = stamps[order], values[order]
    note_gaps(stamps, source, notes, IMU_GAP_FACTOR)
    force = float(np.median(np.linalg.norm(values[:, 3:], axis=1)))
    if not _PLAUSIBLE_FORCE_M_S2[0] < force < _PLAUSIBLE_FORCE_M_S2[1]:
        notes.add(f"{source}: the median specific force is {force:.2f} m/s², gravity is 9.81; check the unit")
    rate = float(np.quantile(np.linalg.norm(values[:, :3], axis=1), 0.95))
    if rate > _MAX_RATE_RAD_S:
        notes.add(
            f"{source}: angular velocities reach {rate:.0f} rad/s; check the unit (name columns gx_deg_s for °/s)"
        )
    return ImuSamples(stamps, values[:, :3], values[:, 3:])
