"""Time stamps as recordings write them: read to nanoseconds, put in order, and their gaps described."""

from __future__ import annotations

import re
from bisect import bisect_left
from collections.abc import Callable
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybridlio.core.errors import DataError
from hybridlio.core.sensors import NS_PER_S
from hybridlio.datasets.sequence import Notes

Stamps = NDArray[np.int64]

_LEAST_STEP_NS = 5_000_000
_LARGEST_STEP_S = 10.0
_ISO = re.compile(r"(\d{4}-\d\d-\d\d.*?)(?:Z|([+-])(\d\d):?(\d\d))?")
MISSING_STAMP = int(np.iinfo(np.int64).min)  # what a blank line reads as; NumPy's "not a time" has the same bits


def _iso_ns(text: str) -> int:
    date, sign, hours, minutes = _ISO.fullmatch(text).groups(default="0")  # type: ignore[union-attr]
    if not 1678 <= int(date[:4]) <= 2261:  # NumPy would wrap around without a word
        raise OverflowError
    east_ns = int(f"{sign}1") * (60 * int(hours) + int(minutes)) * 60 * NS_PER_S if sign != "0" else 0
    return int(np.datetime64(date.replace(" ", "T"), "ns").astype(np.int64)) - east_ns


def _seconds_ns(text: str) -> int:
    return int((Decimal(text) * NS_PER_S).to_integral_value())  # a float64 would round seconds since 1970 to 0.2 µs


def _parser(lines: list[str]) -> Callable[[str], int]:
    first = next(filter(None, lines))
    if re.match(r"\d{4}-\d\d-\d\d", first):
        return _iso_ns
    seconds = any(re.search(r"[.eE]", line) for line in lines)  # one whole second among others is no nanosecond
    return _seconds_ns if seconds or not re.fullmatch(r"[+-]?\d+", first) else int


def read_stamps(path: Path) -> Stamps:
    """Stamps ``(N,)`` of a text file with one a line: whole numbers are nanoseconds, or seconds where any line has a
    point or an exponent, and dates such as ``2011-09-26 13:04:32.349659964`` ISO 8601, in UTC unless they say how far
    off it they are (``+02:00``).

    A blank line, as for a frame that was not recorded, reads as ``MISSING_STAMP``.

    Raises:
        DataError: the file is missing, empty, or a row does not read like the first; names file and row.
    """
    if not path.is_file():
        raise DataError(f"{path}: no such file; expected one time stamp a line")
    lines = [line.strip() for line in path.read_text(encoding="utf-8", errors="replace").rstrip().splitlines()]
    if not any(lines):
        raise DataError(f"{path}: empty; expected one time stamp a line")
    parse = _parser(lines)
    stamps = np.full(len(lines), MISSING_STAMP)
    for row, line in enumerate(lines):
        try:
            stamps[row] = parse(line) if line else MISSING_STAMP
        except (ValueError, InvalidOperation, OverflowError, AttributeError):
            raise DataError(f"{path}, line {row + 1}: cannot read {line[:40]!r} as a time stamp") from None
    known = stamps[stamps != MISSING_STAMP]
    if parse is int and len(known) > 1 and 0 < np.median(np.abs(np.diff(known))) < 1000:
        raise DataError(f"{path}: whole numbers are nanoseconds, yet these are under 1 µs apart; write seconds as 1.0")
    return stamps


def increasing(stamps: Stamps) -> NDArray[np.intp]:
    """Indices of a longest strictly increasing part of ``stamps``: what is left when the fewest are dropped.

    Of rows with the same stamp the first is kept: whoever writes one twice has missed the second's own.
    """
    if (np.diff(stamps) > 0).all():
        return np.arange(len(stamps))
    tails: list[int] = []  # smallest last stamp of an increasing run, by its length
    tail_at: list[int] = []
    before: list[int] = []
    for k, stamp in enumerate(stamps.tolist()):
        length = bisect_left(tails, stamp)
        if tails[length : length + 1] == [stamp]:
            before.append(-1)
            continue
        before.append(tail_at[length - 1] if length else -1)
        tails[length : length + 1] = [stamp]
        tail_at[length : length + 1] = [k]
    chain, k = [], tail_at[-1]
    while k >= 0:
        chain.append(k)
        k = before[k]
    return np.array(chain[::-1], dtype=np.intp)


def usable_scans(stamps: Stamps, path: Path) -> NDArray[np.intp]:
    """Indices of the scans to keep: a longest part of ``stamps`` that increases.

    Raises:
        DataError: that is less than half of them, or scans would follow each other within 5 ms: stamps with too few
            digits or in another unit; names ``path``, their file.
    """
    keep = increasing(stamps)
    if 2 * len(keep) < len(stamps):
        raise DataError(
            f"{path}: only {len(keep)} of {len(stamps)} scans have stamps that increase; do they lack digits?"
        )
    step_ns = float(np.median(np.diff(stamps[keep]))) if len(keep) > 1 else _LEAST_STEP_NS
    if step_ns < _LEAST_STEP_NS:
        raise DataError(f"{path}: scans are {step_ns / 1e6:g} ms apart; whole numbers are nanoseconds, write s as 1.0")
    return keep


def sorted_unique(stamps: Stamps, what: str, notes: Notes) -> NDArray[np.intp]:
    """Indices that put ``stamps`` in order, each stamp once (the first row that has it); says how many were wrong."""
    backwards = int((np.diff(stamps) < 0).sum())
    _, first = np.unique(stamps, return_index=True)
    repeats = len(stamps) - len(first)
    if backwards or repeats:
        notes.add(
            f"{what}: {backwards} of {len(stamps)} stamps go backwards and {repeats} repeat; sorted, repeats dropped"
        )
    return first


def note_gaps(stamps: Stamps, what: str, notes: Notes, factor: float) -> None:
    """Say how many steps in ``stamps`` exceed ``factor`` times the median step, and which is the longest.

    A median step of over 10 s is told too: stamps may be in another unit.
    """
    steps = np.diff(stamps) / NS_PER_S
    if not len(steps):
        return
    if len(steps) > 1 and np.median(steps) > _LARGEST_STEP_S:
        notes.add(f"{what}: {np.median(steps):g} s apart; check that their stamps are in seconds, or whole nanoseconds")
    large = int((steps > factor * np.median(steps)).sum())
    if large:
        worst = int(steps.argmax())
        notes.add(f"{what}: {large} gaps, the longest {steps[worst]:.3f} s after row {worst}")


def note_coverage(stamps: Stamps, scans: Stamps, what: str, notes: Notes, of: str = "scan") -> None:
    """Say where ``stamps``, if there are any, begin after the first scan or end before the last by over 0.15 s.

    ``of`` is what to call ``scans`` where they are something else.

    Raises:
        DataError: the two share no time at all, as with clocks of different origin.
    """
    if not len(stamps):
        return
    if stamps[0] > scans[-1] or stamps[-1] < scans[0]:
        away = float(stamps[0] - scans[0]) / NS_PER_S
        raise DataError(
            f"{notes.name}: {what} begins {away:+.1f} s from the first {of} and shares no time with the {of}s"
        )
    late, early = (stamps[0] - scans[0]) / NS_PER_S, (scans[-1] - stamps[-1]) / NS_PER_S
    if late > 0.15:
        notes.add(f"{what} starts {late:.2f} s after the first {of}")
    if early > 0.15:
        notes.add(f"{what} ends {early:.2f} s before the last {of}")
