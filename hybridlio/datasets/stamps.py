"""Time stamps of recordings: read exactly to nanoseconds, checked and sorted; their gaps are noted."""

from __future__ import annotations

import re
from bisect import bisect_left
from collections.abc import Callable
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybridlio.core.arrays import Stamps
from hybridlio.core.errors import DataError
from hybridlio.core.sensors import NS_PER_S
from hybridlio.core.tables import counted
from hybridlio.datasets.csv_times import is_date, iso_ns
from hybridlio.datasets.notes import Notes

MISSING_STAMP = int(np.iinfo(np.int64).min)  # stands for a blank line; NumPy's NaT has the same bits

SCAN_GAP_FACTOR = 1.5  # a step over 1.5 times the median one: a scan is missing, jitter alone is far smaller
IMU_GAP_FACTOR = 5.0  # IMU drivers deliver in bursts; shorter gaps are interpolated without harm
_MIN_SCAN_STEP_NS = 5_000_000  # no lidar makes 200 scans a second: the unit is wrong
_MAX_STEP_S = 10.0  # no sensor is slower: the unit is wrong
_MIN_WHOLE_STEP_NS = 1000  # no sensor delivers whole nanoseconds at over 1 MHz: these are seconds
_MAX_UNCOVERED_S = 0.15  # beyond the first or last scan: one and a half scans at 10 Hz


def seconds_ns(text: str) -> int:
    """Convert decimal seconds to nanoseconds exactly; a float64 would round seconds since 1970 to 0.2 µs."""
    return int((Decimal(text) * NS_PER_S).to_integral_value())


def _parser(lines: list[str]) -> Callable[[str], int]:
    first = next(filter(None, lines))
    if is_date(first):
        return iso_ns
    # all lines, because a single stamp among seconds may be written without a point
    is_seconds = any(re.search(r"[.eE]", line) for line in lines)
    return seconds_ns if is_seconds or not re.fullmatch(r"[+-]?\d+", first) else int


def read_stamps(path: Path) -> Stamps:
    """Read the stamps ``(N,)`` of a text file with one per line.

    A file has one of three formats: ISO 8601 dates such as ``2011-09-26 13:04:32.349659964``, in UTC or with an offset
    (``+02:00``); seconds, if any line has a decimal point or exponent; else whole nanoseconds. A blank line, as for a
    frame that was not recorded, reads as :data:`MISSING_STAMP`; lines that start with ``#`` are comments.

    Raises:
        DataError: the file is missing or empty, a line does not have the format of the first (the message names file
            and line), or whole numbers are too close together to be nanoseconds.
    """
    if not path.is_file():
        raise DataError(f"{path}: no such file; expected one time stamp per line")
    text = path.read_text(encoding="utf-8", errors="replace").rstrip()
    numbered = {k: line.strip() for k, line in enumerate(text.splitlines(), 1) if not line.startswith("#")}
    lines = list(numbered.values())
    if not any(lines):
        raise DataError(f"{path}: empty; expected one time stamp per line")
    parse = _parser(lines)
    stamps = np.full(len(lines), MISSING_STAMP)
    for row, (number, line) in enumerate(numbered.items()):
        try:
            stamps[row] = parse(line) if line else MISSING_STAMP
        except (ValueError, InvalidOperation, OverflowError, AttributeError):
            raise DataError(f"{path}, line {number}: cannot read {line[:40]!r} as a time stamp") from None
    known = stamps[stamps != MISSING_STAMP]
    if parse is int and len(known) > 1 and 0 < np.median(np.abs(np.diff(known))) < _MIN_WHOLE_STEP_NS:
        raise DataError(
            f"{path}: whole numbers are read as nanoseconds, but these are under 1 µs apart; write nanoseconds, or "
            "seconds as 1.0"
        )
    return stamps


def increasing(stamps: Stamps) -> NDArray[np.intp]:
    """Return the indices of a longest strictly increasing subsequence: the fewest stamps are dropped.

    Of rows with the same stamp the first is kept, because a writer that repeats a stamp has missed the second's own.
    """
    if (np.diff(stamps) > 0).all():
        return np.arange(len(stamps))
    tails: list[int] = []  # smallest last stamp of an increasing subsequence, by its length
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
    """Return the indices of the scans to keep: those of a longest strictly increasing subsequence of ``stamps``.

    Raises:
        DataError: it holds less than half of the scans, or scans are under 5 ms apart: the stamps lack digits or have
            another unit. The message names ``path``, their file.
    """
    keep = increasing(stamps)
    if 2 * len(keep) < len(stamps):
        raise DataError(
            f"{path}: only {len(keep)} of {len(stamps)} scans have increasing stamps; write them with more digits"
        )
    step_ns = float(np.median(np.diff(stamps[keep]))) if len(keep) > 1 else _MIN_SCAN_STEP_NS
    if step_ns < _MIN_SCAN_STEP_NS:
        raise DataError(
            f"{path}: scans are {step_ns / 1e6:g} ms apart; whole numbers are read as nanoseconds: write seconds as 1.0"
        )
    return keep


def sorted_unique(stamps: Stamps, what: str, notes: Notes) -> NDArray[np.intp]:
    """Return the indices that sort ``stamps``, of equal stamps the first; note how many were out of order."""
    backwards = int((np.diff(stamps) < 0).sum())
    _, first = np.unique(stamps, return_index=True)
    repeats = len(stamps) - len(first)
    if backwards or repeats:
        notes.corrected(
            f"{what}: of {len(stamps)} stamps {backwards} go backwards and {repeats} repeat; sorted, repeats dropped"
        )
    return first


def note_gaps(stamps: Stamps, what: str, notes: Notes, factor: float) -> None:
    """Note how many steps between ``stamps`` exceed ``factor`` times the median step, and the longest.

    Also notes a median step over 10 s, a sign of another unit.
    """
    steps = np.diff(stamps) / NS_PER_S
    if not len(steps):
        return
    if len(steps) > 1 and np.median(steps) > _MAX_STEP_S:
        notes.add(f"{what}: {np.median(steps):g} s apart; check that stamps are in seconds, or whole nanoseconds")
    large = int((steps > factor * np.median(steps)).sum())
    if large:
        worst = int(steps.argmax())
        notes.add(f"{what}: {counted(large, 'gap')}, the longest {steps[worst]:.3f} s after row {worst}")


def note_coverage(stamps: Stamps, scans: Stamps, what: str, notes: Notes, reference: str = "scan") -> None:
    """Note if ``stamps``, unless empty, start over 0.15 s after the first scan or end over 0.15 s before the last.

    Args:
        stamps: ``(N,)`` of the sensor, sorted.
        scans: ``(M,)`` to compare with, sorted.
        what: name of the sensor's data.
        notes: receives the notes.
        reference: name of one of ``scans``, if they are not scans.

    Raises:
        DataError: the two do not overlap, as with clocks of different origin.
    """
    if not len(stamps):
        return
    if stamps[0] > scans[-1] or stamps[-1] < scans[0]:
        offset_s = float(stamps[0] - scans[0]) / NS_PER_S
        raise DataError(
            f"{notes.name}: {what} starts {offset_s:+.1f} s from the first {reference} and does not overlap the "
            f"{reference}s in time; bring both to one clock"
        )
    late, early = (stamps[0] - scans[0]) / NS_PER_S, (scans[-1] - stamps[-1]) / NS_PER_S
    if late > _MAX_UNCOVERED_S:
        notes.add(f"{what} starts {late:.2f} s after the first {reference}")
    if early > _MAX_UNCOVERED_S:
        notes.add(f"{what} ends {early:.2f} s before the last {reference}")
