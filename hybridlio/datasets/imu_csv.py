"""Inertial samples from a CSV file whose header names the columns and, where it can, their units."""

from __future__ import annotations

from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybridlio.core.errors import DataError
from hybridlio.core.sensors import NS_PER_S, ImuSamples
from hybridlio.datasets.csv_rows import read_csv
from hybridlio.datasets.sequence import Notes
from hybridlio.datasets.stamps import note_gaps, sorted_unique

_STANDARD_GRAVITY_M_S2 = 9.80665
_FASTEST_RAD_S = 6.0  # a turn a second: of a vehicle, or of a hand for long, only degrees taken for radians
_UNITS = {
    "g": {"": 1.0, "_rad_s": 1.0, "_deg_s": np.pi / 180},
    "a": {"": 1.0, "_m_s2": 1.0, "_g": _STANDARD_GRAVITY_M_S2},
}
_EXPECTED = "stamp_ns (or t_s), gx gy gz (rad/s; or gx_deg_s …), ax ay az (m/s²; or ax_g …)"


def read_imu_csv(path: Path, notes: Notes) -> ImuSamples:
    """Samples of a CSV file, in order of time.

    The time is ``stamp_ns`` (whole nanoseconds) or ``t_s`` (seconds) on the scans' clock. Angular velocity is
    ``gx gy gz`` in rad/s, or ``gx_deg_s`` and so on; specific force ``ax ay az`` in m/s², or ``ax_g`` and so on. Other
    columns are ignored. Stamps out of order are sorted, repeated ones and rows that are not finite dropped, with notes.

    Raises:
        DataError: a column is missing, or a row is malformed; names file and line.
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
            raise DataError(f"{path}, line {line}: not all numbers: {','.join(row)[:80]}") from None
    return _clean(path, stamps, values, notes)


def _columns(path: Path, header: list[str]) -> tuple[int, list[tuple[int, float]]]:
    """The time's column, and for gx gy gz ax ay az the column and the factor to rad/s or m/s²."""
    times = [header.index(name) for name in ("stamp_ns", "t_s") if name in header]
    found = []
    for kind, axis in ((kind, axis) for kind in "ga" for axis in "xyz"):
        names = {kind + axis + unit: scale for unit, scale in _UNITS[kind].items()}
        found += [(header.index(name), scale) for name, scale in names.items() if name in header][:1]
    if not times or len(found) != 6:
        raise DataError(f"{path}: the header must name {_EXPECTED}; found: {', '.join(header) or 'nothing'}")
    return times[0], found


def _stamp_ns(text: str, name: str) -> int:
    return int(text) if name == "stamp_ns" else int((Decimal(text.strip()) * NS_PER_S).to_integral_value())


def _clean(path: Path, stamps: NDArray[np.int64], values: NDArray[np.float64], notes: Notes) -> ImuSamples:
    finite = np.isfinite(values).all(axis=1)
    if not finite.any():
        raise DataError(f"{path}: no row of finite values")
    if not finite.all():
        notes.add(f"{path}: dropped {int((~finite).sum())} rows that are not finite, first row {int(finite.argmin())}")
    stamps, values = stamps[finite], values[finite]
    order = sorted_unique(stamps, str(path), notes)
    stamps, values = stamps[order], values[order]
    note_gaps(stamps, str(path), notes, factor=5.0)
    force = float(np.median(np.linalg.norm(values[:, 3:], axis=1)))
    if not 5 < force < 20:
        notes.add(f"{path}: the median specific force is {force:.2f} m/s², far from gravity's 9.81; check the unit")
    turn = float(np.quantile(np.linalg.norm(values[:, :3], axis=1), 0.95))
    if turn > _FASTEST_RAD_S:
        notes.add(f"{path}: angular velocities of {turn:.0f} rad/s are no vehicle's; check the unit (gx_deg_s for °/s)")
    return ImuSamples(stamps, values[:, :3], values[:, 3:])
