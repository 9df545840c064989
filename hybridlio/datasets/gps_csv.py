"""GPS fixes from a CSV file."""

from __future__ import annotations

from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from hybridlio.core.arrays import Stamps
from hybridlio.core.errors import DataError
from hybridlio.core.geodesy import GeodeticPoint, check_geodetic, enu_from_geodetic, origin_of
from hybridlio.core.sensors import NS_PER_S, GpsFix
from hybridlio.datasets.csv_rows import read_csv
from hybridlio.datasets.notes import Notes

_LOCAL, _GEODETIC = ("east", "north", "up"), ("latitude", "longitude", "height")
_MIN_SIGMA_M = 1e-3  # a fix declared exact (sigma 0) still needs an invertible covariance


def read_gps_csv(path: Path) -> tuple[GpsFix, ...]:
    """Read GPS fixes from a CSV file, sorted by time; none if the file does not exist.

    Columns, in any order; others are ignored:

    * ``stamp_ns``, whole nanoseconds, or ``t_s``, seconds;
    * ``sigma``, standard deviation on each axis in metres;
    * the antenna's position: ``east north up`` in metres, in a local frame of the file's own, or
      ``latitude longitude height`` in degrees and metres (WGS 84), from which a local frame at the first row is made.
      With both, the local frame is the file's own, and its origin on Earth follows from the first row.

    Raises:
        DataError: a column is missing, or a row is malformed or has an impossible latitude or longitude; the message
            names file and line.
    """
    if not path.is_file():
        return ()
    header, rows = read_csv(path)
    local, geodetic = set(header) >= set(_LOCAL), set(header) >= set(_GEODETIC)
    time = "t_s" if "t_s" in header and "stamp_ns" not in header else "stamp_ns"
    if not set(header) >= {time, "sigma"} or not (local or geodetic):
        missing = {time, "sigma", *_LOCAL} - set(header)
        raise DataError(
            f"{path}: the header lacks {', '.join(sorted(missing))}; expected stamp_ns or t_s, sigma and "
            f"{','.join(_LOCAL)} or {','.join(_GEODETIC)}"
        )
    names = (time, "sigma") + (_LOCAL if local else ()) + (_GEODETIC if geodetic else ())
    read = [_numbers(path, line, dict(zip(header, row, strict=True)), names) for line, row in rows]
    if not read:
        return ()
    first = GeodeticPoint(*read[0][-3:]) if geodetic else None
    origin = origin_of(read[0][2:5], first) if first is not None and local else first
    return tuple(sorted((_fix(numbers, local, origin) for numbers in read), key=lambda fix: fix.stamp_ns))


def _numbers(path: Path, line: int, row: dict[str, str], names: tuple[str, ...]) -> list[float]:
    """Return the row's numbers in the order of ``names``; the stamp, first, as an exact int."""
    try:
        numbers = [_stamp(row[names[0]], names[0]), *(float(row[name]) for name in names[1:])]
    except (ValueError, TypeError, InvalidOperation, OverflowError):
        raise DataError(f"{path}, line {line}: expected numbers in {','.join(names)}") from None
    if not np.isfinite(numbers[1:]).all() or numbers[1] < 0:
        raise DataError(f"{path}, line {line}: the position must be finite and sigma 0 or more")
    if names[-len(_GEODETIC) :] == _GEODETIC:
        latitude, longitude, height = numbers[-len(_GEODETIC) :]
        check_geodetic(latitude, longitude, height, f"{path}, line {line}")
    return numbers


def _stamp(text: str, name: str) -> int:
    """Return a stamp in nanoseconds, exactly."""
    return int(text) if name == "stamp_ns" else int((Decimal(text) * NS_PER_S).to_integral_value())


def _fix(numbers: list[float], local: bool, origin: GeodeticPoint | None) -> GpsFix:
    stamp, sigma = int(numbers[0]), max(numbers[1], _MIN_SIGMA_M)
    given = np.array(numbers[2:5])
    position = given if local or origin is None else enu_from_geodetic([given], origin)[0]
    return GpsFix(stamp, position, sigma**2 * np.eye(3), origin)


def note_fixes(fixes: tuple[GpsFix, ...], scans_ns: Stamps, notes: Notes) -> None:
    """Note if there are fixes, but none between the first and the last scan: the clocks probably differ."""
    if fixes and not any(scans_ns[0] <= fix.stamp_ns <= scans_ns[-1] for fix in fixes):
        offset_s = (fixes[0].stamp_ns - int(scans_ns[0])) / NS_PER_S
        notes.add(f"no GPS fix is between the first and the last scan: fixes start {offset_s:+.1f} s from the first")
