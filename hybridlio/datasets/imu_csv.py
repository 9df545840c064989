"""IMU samples from a CSV file, whose header names the columns and optionally their units."""

from __future__ import annotations

from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from hybridlio.core.arrays import Array, Stamps
from hybridlio.core.errors import DataError
from hybridlio.core.sensors import ImuSamples
from hybridlio.datasets.csv_rows import read_csv
from hybridlio.datasets.csv_times import ColumnError
from hybridlio.datasets.imu_columns import STANDARD_GRAVITY_M_S2, imu_columns
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.stamps import IMU_GAP_FACTOR, note_gaps, sorted_unique

_PLAUSIBLE_FORCE_M_S2 = (5.0, 20.0)  # of the median: half to twice gravity; values in g (1) or mm/s² (9810) are outside
_MAX_RATE_RAD_S = 6.0  # 95 % quantile; a turn per second is beyond vehicles and hands, but 6 °/s taken for rad/s is not
_NO_RATE_RAD_S = 35.0  # 95 % quantile: 2000 °/s, the full scale of usual gyroscopes, so the unit is °/s
_ONE_G = (0.8, 1.25)  # of the median force: gravity in g, and some motion
_STEPS_NS = (500_000, 400_000_000)  # between samples, 2.5 Hz to 2 kHz: units are 1000 apart, so at most one fits
_IMPOSSIBLE = 1e6  # in m/s² or rad/s, and in units that are mistaken for them: damaged numbers, which would overflow
_EXPECTED = (
    "a time (stamp_ns, t_s, timestamp …), gx gy gz (rad/s; or gx_deg_s …) and ax ay az (m/s²; or ax_g …), or the names "
    "of ROS or EuRoC"
)


def read_imu_csv(path: Path, notes: Notes) -> ImuSamples:
    """Read IMU samples from a CSV file, sorted by time.

    Columns, in any order, by the names of :mod:`hybridlio.datasets.imu_columns`; others are ignored:

    * the time, on the scans' clock. Without a unit in the header it is found from the distance between samples;
    * angular velocity in the IMU frame, in rad/s unless the header says otherwise or values are beyond 2000 °/s;
    * specific force in the IMU frame (+9.81 at rest on the axis that points up), in m/s² unless the header says
      otherwise or its median is 1 g.

    Repeated stamps and rows that are not finite are dropped. Both are noted, as are gaps, units that were found from
    the values, and implausible units.

    Raises:
        DataError: a column is missing, a row is malformed, or no row is finite; the message names file and line.
    """
    header, rows = read_csv(path)
    try:
        columns = imu_columns(header)
    except ColumnError as error:
        found = ", ".join(header) or "nothing"
        raise DataError(f"{path}: the header must name {_EXPECTED}; it {error}; found: {found}") from None
    times: list[int | Decimal] = []
    values = np.empty((len(rows), 6))
    for k, (line, row) in enumerate(rows):
        try:
            times.append(columns.time.read(row))
            values[k] = [float(row[column]) * (scale or 1.0) for column, scale in columns.values]
        except (ValueError, InvalidOperation, OverflowError):
            raise DataError(f"{path}, line {line}: expected numbers, found {','.join(row)[:80]}") from None
    units = [scale is not None for _, scale in columns.values]
    stated = any(units[:3]), any(units[3:])
    stamps = columns.time.stamps(times, _STEPS_NS, "samples", str(path), notes)
    return clean_imu(str(path), stamps, in_si_units(str(path), values, notes, stated), notes)


@np.errstate(over="ignore")  # damaged files hold any number
def in_si_units(source: str, values: Array, notes: Notes, stated: tuple[bool, bool] = (False, False)) -> Array:
    """Return values ``(S, 6)`` in rad/s and m/s², where no unit is stated and the values leave no doubt; noted.

    Args:
        source: the file or topic, for messages.
        values: ``(S, 6)`` angular velocities and specific forces.
        notes: receives the notes.
        stated: whether the unit of the velocities, and of the forces, is stated.
    """
    finite = values[np.isfinite(values).all(axis=1)]
    if not len(finite):
        return values
    factors = np.ones(6)
    force = float(np.median(np.linalg.norm(finite[:, 3:], axis=1)))
    rate = float(np.quantile(np.linalg.norm(finite[:, :3], axis=1), 0.95))
    for unit, size in (("g", 1.0), ("mg", 1000.0)):
        if not stated[1] and _ONE_G[0] * size < force < _ONE_G[1] * size:
            factors[3:] = STANDARD_GRAVITY_M_S2 / size
            notes.corrected(
                f"{source}: the median specific force is {force:.3g}: read in {unit}; in m/s² it is near 9.8"
            )
    if not stated[0] and rate > _NO_RATE_RAD_S:
        factors[:3] = np.pi / 180
        notes.corrected(
            f"{source}: angular velocities reach {rate:.0f}: read in °/s, as no gyroscope measures that many rad/s"
        )
    return values * factors


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
    finite = (np.abs(values) < _IMPOSSIBLE).all(axis=1)  # False for NaN
    if not finite.any():
        raise DataError(f"{source}: no row of finite values")
    if not finite.all():
        notes.corrected(
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
            f"{source}: angular velocities reach {rate:.0f} rad/s; check the unit (gx_deg_s names °/s in imu.csv)"
        )
    return ImuSamples(stamps, values[:, :3], values[:, 3:])
