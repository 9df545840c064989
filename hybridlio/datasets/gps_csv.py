"""GPS fixes from a CSV file, by the names that recorders and exports give the columns.

Known are the names of this project (``stamp_ns``, ``latitude``, ``height``, ``sigma``), of ``rostopic echo -p``
(``field.latitude``, ``field.position_covariance0``), of RTKLIB (``sde(m)``) and the usual ones (``lat_deg``, ``Alt``).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from hybridlio.core.arrays import Array, Stamps
from hybridlio.core.errors import DataError
from hybridlio.core.geodesy import GeodeticPoint, check_geodetic, enu_from_geodetic, origin_of
from hybridlio.core.sensors import NS_PER_S, GpsFix
from hybridlio.core.tables import counted
from hybridlio.datasets.csv_rows import read_csv
from hybridlio.datasets.csv_times import ColumnError, TimeColumn, name_and_unit, time_column
from hybridlio.datasets.notes import Notes

DEFAULT_SIGMA_M = 5.0  # of a fix without one: what single receivers reach under open sky
_MIN_SIGMA_M = 1e-3  # a fix declared exact (sigma 0) still needs an invertible covariance
_STEPS_NS = (15e6, 12e9)  # between fixes, 12 s to 15 ms apart: units are 1000 apart, so at most one fits

_LOCAL = (("east", "e"), ("north", "n"), ("up", "u"))
_GEODETIC = (
    ("latitude", "lat"),
    ("longitude", "long", "lon", "lng"),
    ("height", "ellipsoidalheight", "hgt", "altitude", "alt", "elevation", "ele"),
)
_RECEIVER = re.compile(r"(?:gps|gnss|navsatfix|fix)(?=.)")  # before a name
_UNITS = "deg|degrees|rad|m|cm|mm|ft"  # at the end of a name
_DEGREES = {"deg": 1.0, "degrees": 1.0, "°": 1.0, "rad": 180 / np.pi}
_METRES = {"m": 1.0, "cm": 0.01, "mm": 1e-3, "ft": 0.3048}

_SIGMA = "sigma|stddev|std|sd"
_AXES = tuple("|".join((*_LOCAL[k], *_GEODETIC[g])) for k, g in enumerate((1, 0, 2)))  # longitude is along east
_NOISES: tuple[tuple[str, ...], ...] = (
    (f"{_SIGMA}|accuracy",),
    tuple(f"(?:{_SIGMA})(?:{axis})|(?:{axis})(?:{_SIGMA})" for axis in _AXES),
    tuple(f"(?:{_SIGMA}){axis}|{axis}(?:{_SIGMA}|accuracy)" for axis in ("horizontal", "vertical")),
    tuple(f"positioncovariance{k}" for k in range(9)),
)
_EXPECTED = (
    "a time (stamp_ns, t_s, timestamp …), a position (latitude longitude height, or lat lon alt …, or east north up) "
    "and its standard deviation (sigma)"
)
_Scaled = tuple[tuple[int, float], ...]  # columns, with factors to degrees and metres


@dataclass(frozen=True)
class _GpsColumns:
    """Where the values are in a row.

    Attributes:
        time: of the fixes.
        local: east, north, up; empty if the file has none.
        geodetic: latitude, longitude, height; empty if the file has none.
        noise: one standard deviation, horizontal and vertical ones, those of east, north and up, or the nine of a
            covariance matrix; empty if the file has none.
        status: of a ROS message, negative without a fix; None if the file has none.
    """

    time: TimeColumn
    local: _Scaled
    geodetic: _Scaled
    noise: _Scaled
    status: int | None


@dataclass(frozen=True, eq=False)
class _Row:
    time: int | Decimal
    local: Array
    geodetic: Array
    noise: Array


def read_gps_csv(path: Path, notes: Notes | None = None) -> tuple[GpsFix, ...]:
    """Read GPS fixes from a CSV file, sorted by time; none if the file does not exist.

    Columns, in any order and by the usual names; others are ignored:

    * the time, on the scans' clock. Without a unit in the header it is found from the distance between fixes;
    * the antenna's position: ``east north up`` in a local frame of the file's own, or ``latitude longitude height``
      (WGS 84), from which a local frame at the first fix is made. With both, the local frame is the file's own, and its
      origin on Earth follows from the first fix. Degrees and metres, unless the header says otherwise;
    * the standard deviation, as ``sigma`` on each axis, as those of east, north and up (or of longitude, latitude and
      height), as a horizontal and a vertical one, or as the covariance of a ROS message; else 5 m, which is noted.

    Rows without a fix are left out, which is noted: without a position, with latitude and longitude 0, or with a
    negative ``status``.

    Args:
        path: the file.
        notes: receives the notes.

    Raises:
        DataError: a column is missing, or a row is malformed or has an impossible latitude or longitude; the message
            names file and line.
    """
    if not path.is_file():
        return ()
    notes = Notes(path.name) if notes is None else notes
    header, rows = read_csv(path)
    try:
        columns = _gps_columns(header)
    except ColumnError as error:
        found = ", ".join(header) or "nothing"
        raise DataError(f"{path}: the header must name {_EXPECTED}; it {error}; found: {found}") from None
    read = [_read(f"{path}, line {line}", row, columns) for line, row in rows]
    fixed = [row for row in read if row is not None]
    if len(fixed) < len(read):
        notes.add(f"{path}: {len(read) - len(fixed)} of {len(read)} rows have no fix")
    if not fixed:
        return ()
    return _fixes(path, columns, fixed, notes)


def _gps_columns(header: Sequence[str]) -> _GpsColumns:
    """Find the columns of a file of fixes.

    Raises:
        ColumnError: a column is missing, or a unit is unknown.
    """
    named = [_named(name) for name in header]
    plain = [name for name, _ in named]

    def column(names: str, units: dict[str, float]) -> tuple[int, float] | None:
        for wanted in names.split("|"):
            if wanted in plain:
                found = plain.index(wanted)
                return found, _factor(header[found], named[found][1], units)
        return None

    def columns(wanted: Sequence[Sequence[str]], units: Sequence[dict[str, float]]) -> list[tuple[int, float] | None]:
        return [column("|".join(names), unit) for names, unit in zip(wanted, units, strict=True)]

    local = columns(_LOCAL, [_METRES] * 3)
    geodetic = columns(_GEODETIC, [_DEGREES, _DEGREES, _METRES])
    if None in local and None in geodetic:
        kept = (geodetic, _GEODETIC) if any(geodetic) or not any(local) else (local, _LOCAL)
        lacking = [names[0] for found, names in zip(*kept, strict=True) if found is None]
        raise ColumnError(f"lacks {', '.join(lacking)}")
    noises = (_matching(header, named, patterns) for patterns in _NOISES)
    return _GpsColumns(
        time_column(header),
        () if None in local else tuple(one for one in local if one is not None),
        () if None in geodetic else tuple(one for one in geodetic if one is not None),
        next((noise for noise in noises if noise), ()),
        next((plain.index(name) for name in ("statusstatus", "status") if name in plain), None),
    )


def _named(name: str) -> tuple[str, str | None]:
    """Return the plain name of a column, and its unit if the header has one."""
    base, unit = name_and_unit(name, _UNITS)
    return _RECEIVER.sub("", base, count=1), unit


def _factor(name: str, unit: str | None, units: dict[str, float]) -> float:
    if unit is None:
        return 1.0
    if unit.strip() not in units:
        raise ColumnError(f"has the unknown unit '{unit}' in '{name}'; known: {', '.join(units)}")
    return units[unit.strip()]


def _matching(header: Sequence[str], named: list[tuple[str, str | None]], patterns: Sequence[str]) -> _Scaled:
    """Return one column for each pattern, or none at all."""
    found = [
        next((k for k, (name, _) in enumerate(named) if re.fullmatch(pattern, name)), None) for pattern in patterns
    ]
    if None in found:
        return ()
    units = {f"{unit}²": factor**2 for unit, factor in _METRES.items()} if len(found) == 9 else _METRES
    return tuple((k, _factor(header[k], named[k][1], units)) for k in found if k is not None)


def _read(where: str, row: list[str], columns: _GpsColumns) -> _Row | None:
    """Return the numbers of a row; None if it has no fix.

    Raises:
        DataError: a value is no number, not finite, or impossible.
    """
    try:
        if columns.status is not None and row[columns.status].strip().startswith("-"):
            return None
        local, geodetic = (_numbers(row, part) for part in (columns.local, columns.geodetic))
        if np.isnan(np.r_[local, geodetic]).all() or (len(geodetic) and not geodetic[:2].any()):
            return None
        read = _Row(columns.time.read(row), local, geodetic, _numbers(row, columns.noise))
    except (ValueError, TypeError, InvalidOperation, OverflowError):
        raise DataError(f"{where}: expected numbers, found {','.join(row)[:80]}") from None
    deviations = read.noise if len(read.noise) < 9 else np.zeros(0)  # a covariance may be unknown
    if not np.isfinite(np.r_[local, geodetic, deviations]).all() or (deviations < 0).any():
        raise DataError(f"{where}: the position must be finite and sigma 0 or more")
    if len(geodetic):
        latitude, longitude, height = geodetic
        check_geodetic(latitude, longitude, height, where)
    return read


def _numbers(row: list[str], columns: _Scaled) -> Array:
    return np.array([factor * float(row[column].strip() or "nan") for column, factor in columns])


def _fixes(path: Path, columns: _GpsColumns, rows: list[_Row], notes: Notes) -> tuple[GpsFix, ...]:
    stamps = columns.time.stamps([row.time for row in rows], _STEPS_NS, "fixes", str(path), notes)
    first = GeodeticPoint(*rows[0].geodetic.tolist()) if columns.geodetic else None
    origin = origin_of(rows[0].local, first) if first is not None and columns.local else first
    positions = np.array([row.local if columns.local else row.geodetic for row in rows])
    if not columns.local and origin is not None:
        positions = enu_from_geodetic(positions, origin)
    covariances = assumed_where_unknown([_covariance(row.noise) for row in rows], str(path), notes)
    fixes = (GpsFix(int(t), p, c, origin) for t, p, c in zip(stamps, positions, covariances, strict=True))
    return tuple(sorted(fixes, key=lambda fix: fix.stamp_ns))


def _covariance(noise: Array) -> Array | None:
    """Return the covariance ``(3, 3)`` of the values in the columns of the noise; None if it is unknown."""
    if len(noise) == 9:
        return usable_covariance(noise.reshape(3, 3))
    if not len(noise):
        return None
    axes = {1: [0, 0, 0], 2: [0, 0, 1], 3: [0, 1, 2]}[len(noise)]
    return np.asarray(np.diag(np.maximum(noise[axes], _MIN_SIGMA_M) ** 2))


def usable_covariance(given: Array) -> Array | None:
    """Return a fix's covariance ``(3, 3)``, no smaller than 1 mm; None if it is unknown, zero or not positive."""
    if not np.isfinite(given).all() or not (np.diag(given) > 0).all():
        return None
    raised = (given + given.T) / 2 + np.diag(np.maximum(_MIN_SIGMA_M**2 - np.diag(given), 0))
    return raised if np.linalg.eigvalsh(raised)[0] > 0 else None


def assumed_where_unknown(covariances: list[Array | None], source: str, notes: Notes) -> list[Array]:
    """Return covariances with that of 5 m where there is none, which is noted.

    Args:
        covariances: of the fixes.
        source: the file or topic, for the note.
        notes: receives the note.
    """
    if unknown := sum(one is None for one in covariances):
        notes.add(f"{source}: {counted(unknown, 'fix', 'fixes')} without covariance; {DEFAULT_SIGMA_M:g} m are assumed")
    return [DEFAULT_SIGMA_M**2 * np.eye(3) if one is None else one for one in covariances]


def note_fixes(fixes: tuple[GpsFix, ...], scans_ns: Stamps, notes: Notes) -> None:
    """Note if there are fixes, but none between the first and the last scan: the clocks probably differ."""
    if fixes and not any(scans_ns[0] <= fix.stamp_ns <= scans_ns[-1] for fix in fixes):
        offset_s = (fixes[0].stamp_ns - int(scans_ns[0])) / NS_PER_S
        notes.add(f"no GPS fix is between the first and the last scan: fixes start {offset_s:+.1f} s from the first")
