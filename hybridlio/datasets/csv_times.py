"""The time of rows in CSV files: which column holds it, in which unit, read exactly to nanoseconds."""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal
from itertools import pairwise

import numpy as np

from hybridlio.core.arrays import NS_PER_S, Stamps
from hybridlio.core.errors import DataError
from hybridlio.datasets.notes import Notes

_UNITS = "s|sec|ms|us|ns|nsec"  # at the end of a name
_TIMES = ("stamp", "headerstamp", "t", "time", "timestamp", "stamps", "timestamps")
_STATED = {"s": NS_PER_S, "sec": NS_PER_S, "ms": 10**6, "us": 1000, "µs": 1000, "ns": 1, "nsec": 1}
_TOLD = {unit: _STATED[unit] for unit in ("ns", "us", "ms", "s")}  # units that are told from the values
_PAIRS = (("secs", "nsecs"), ("sec", "nsec"), ("sec", "nanosec"), ("seconds", "nanoseconds"))

_YEARS = (1678, 2261)  # whole years that fit int64 nanoseconds; NumPy wraps others around without an error
_ISO = re.compile(r"(\d{4}-\d\d-\d\d.*?)(?:Z|([+-])(\d\d):?(\d\d))?")


class Date(int):
    """Nanoseconds since 1970 of a time that stands as an ISO 8601 date."""


class ColumnError(ValueError):
    """A header that lacks a column, or names an unknown unit; the message says which."""


@dataclass(frozen=True)
class TimeColumn:
    """Where the time is in a row.

    Attributes:
        name: as the header has it.
        column: of the time; for a pair of seconds and nanoseconds, of the seconds.
        unit_ns: nanoseconds of its unit; None if the header does not say.
        nanoseconds: column of the nanoseconds of a pair, or None.
    """

    name: str
    column: int
    unit_ns: int | None
    nanoseconds: int | None = None

    def read(self, row: Sequence[str]) -> int | Decimal:
        """Return a row's time: an integer for nanoseconds and dates, else decimal in the header's unit, all exact.

        Raises:
            ValueError, OverflowError, decimal.InvalidOperation: it is no finite number, and no date.
        """
        text = row[self.column].strip()
        if self.nanoseconds is None and is_date(text):
            return Date(iso_ns(text))
        if self.nanoseconds is not None:
            return int(text) * NS_PER_S + int(row[self.nanoseconds])
        if self.unit_ns == 1:
            return int(text)
        value = Decimal(text)
        if not value.is_finite():
            raise ValueError(text)
        return value

    def stamps(
        self, times: Sequence[int | Decimal], steps_ns: tuple[float, float], what: str, file: str, notes: Notes
    ) -> Stamps:
        """Return the stamps ``(N,)`` in nanoseconds of times that :meth:`read` returned.

        Without a unit in the header it is that in which rows are usually spaced, which is noted.

        Args:
            times: of the rows.
            steps_ns: shortest and longest usual distance between rows; within a factor of 1000 one unit fits at most.
            what: the rows, for messages, such as "samples".
            file: for messages.
            notes: receives the unit that was found.

        Raises:
            DataError: no unit fits, a time is beyond int64 nanoseconds, or only some times are dates.
        """
        dates = sum(isinstance(time, Date) for time in times)
        if dates:
            if dates < len(times):
                raise DataError(f"{file}: '{self.name}' holds dates in some rows and numbers in others")
            notes.found(f"{file}: '{self.name}' holds dates, in UTC where they state no offset")
            return np.array(times, dtype=np.int64)
        unit_ns = 1 if self.nanoseconds is not None else self.unit_ns
        if unit_ns is None and times:
            unit_ns = self._told_unit(times, steps_ns, what, file, notes)
        try:
            return np.array([round(time * (unit_ns or 1)) for time in times], dtype=np.int64)
        except OverflowError:
            raise DataError(f"{file}: a time is beyond the range of int64 nanoseconds; check its unit") from None

    def _told_unit(
        self, times: Sequence[int | Decimal], steps_ns: tuple[float, float], what: str, file: str, notes: Notes
    ) -> int:
        steps = [float(abs(Decimal(b) - Decimal(a))) for a, b in pairwise(times) if a != b]
        step = float(np.median(steps)) if steps else 0.0
        fitting = [unit for unit, ns in _TOLD.items() if steps_ns[0] <= step * ns <= steps_ns[1]]
        if len(fitting) != 1:
            raise DataError(
                f"{file}: the unit of '{self.name}' cannot be told, {what} are {step:g} apart; name the column "
                f"{self.name}_s, {self.name}_ms, {self.name}_us or {self.name}_ns"
            )
        notes.found(f"{file}: '{self.name}' is read in {fitting[0]}, {what} are {step:g} apart")
        return _TOLD[fitting[0]]


def is_date(text: str) -> bool:
    """Return whether a text begins with an ISO 8601 date."""
    return re.match(r"\d{4}-\d\d-\d\d", text) is not None


def iso_ns(text: str) -> int:
    """Convert an ISO 8601 date with a time, in UTC or with an offset, to nanoseconds since 1970.

    Raises:
        ValueError, OverflowError: it is none, or beyond int64.
    """
    date, sign, hours, minutes = _ISO.fullmatch(text).groups(default="0")  # type: ignore[union-attr]
    if not _YEARS[0] <= int(date[:4]) <= _YEARS[1]:
        raise OverflowError
    east_ns = int(f"{sign}1") * (60 * int(hours) + int(minutes)) * 60 * NS_PER_S if sign != "0" else 0
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)  # NumPy warns of what it takes for the name of a time zone
        try:
            return int(np.datetime64(date.replace(" ", "T"), "ns").astype(np.int64)) - east_ns
        except UserWarning:
            raise ValueError from None


def plain_name(name: str) -> str:
    """Return a column's name in lower case, without separators and the prefix of exported ROS messages."""
    return re.sub(r"[\s._%\-]", "", name.lower().removeprefix("field."))


def name_and_unit(name: str, units: str) -> tuple[str, str | None]:
    """Split a column's name as ``t_s``, ``t [s]`` or ``t(s)``.

    Args:
        name: as the header has it.
        units: that may stand behind ``_``, separated by ``|``; in brackets any may.

    Returns:
        The plain name, and the unit, None if the header has none.
    """
    parts = re.fullmatch(rf"(.*?)\s*(?:[\[(]([^\])]*)[\])]|_({units}))", name.lower())
    return (plain_name(parts[1]), parts[2] or parts[3]) if parts else (plain_name(name), None)


def time_column(header: Sequence[str]) -> TimeColumn:
    """Find the time among the columns of a CSV file.

    Raises:
        ColumnError: there is none, or its unit is unknown.
    """
    plain = [plain_name(name) for name in header]
    for seconds, nanoseconds in _PAIRS:
        for column, name in enumerate(plain):
            partner = name.removesuffix(seconds) + nanoseconds
            if name.endswith(seconds) and partner in plain:
                return TimeColumn(header[column], column, NS_PER_S, plain.index(partner))
    for wanted in _TIMES:
        for column, name in enumerate(header):
            base, unit = name_and_unit(name, _UNITS)
            if base == wanted:
                if unit is not None and unit.strip() not in _STATED:
                    raise ColumnError(f"has the unknown unit '{unit}' in '{name}'; known: {', '.join(_STATED)}")
                return TimeColumn(name, column, None if unit is None else _STATED[unit.strip()])
    raise ColumnError("lacks a time such as stamp_ns or t_s")
