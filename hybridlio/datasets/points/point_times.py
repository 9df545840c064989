"""The meaning of a column of point times: the only place that decides it, for every reader.

Vendors name the column differently, and write seconds, milliseconds, microseconds, nanoseconds or shares of the sweep,
counted from the scan's stamp, from 1970 or from the sensor's start. :func:`find_point_times` finds the convention from
the values of several scans, the length of a sweep and the distance between stamps; :meth:`PointTimes.offsets_ns`
applies it to each scan.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridlio.core.arrays import NS_PER_S, Stamps
from hybridlio.core.errors import DataError
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.points.likely_times import note_likely
from hybridlio.datasets.points.whole_times import HOW_TO_STATE, readable, whole_ns

Columns = Mapping[str, NDArray[Any]]

UNITS_NS = {"s": NS_PER_S, "ms": 1_000_000, "us": 1000, "ns": 1}
NORMALISED = "normalised"
ORIGINS = ("stamp", "absolute", "start", "middle", "end")
# in order of preference; lower case, without a suffix that names the unit; compared without underscores
_NAMES = (
    *("t", "time", "timestamp", "timestamps", "time_stamp", "offset_time", "time_offset", "timeoffset", "ts", "offset"),
    *("relative_time", "time_relative", "relative_timestamp", "dt", "delta_t", "delta_time", "utime"),
    *("point_timestamp", "toffset", "t_offset", "point_time", "point_time_offset", "rel_time", "reltime", "time_rel"),
    *("gps_time", "stamp"),
)
_SUFFIXES = {"_s": "s", "_sec": "s", "_ms": "ms", "_us": "us", "_ns": "ns", "_nsec": "ns"}

_MAX_OFFSET_NS = NS_PER_S  # no lidar turns slower than once a second
_MIN_SWEEP_NS = 2_000_000  # no lidar makes 500 sweeps a second
_MAX_SWEEP_NS = 1_200_000_000  # a sweep of 1 s and some jitter
_MAX_SWEEP_IN_STEPS = 2.5  # scans of merged lidars overlap; units differ by 1000, so a generous bound stays unique
_USUAL_SWEEP_NS = 250_000_000  # at most, where a single scan leaves the distance between stamps unknown: 4 Hz
_FULL_SHARE = 0.9  # of 0 to 1: the points of a sweep that is written as shares reach at least so far
_MIN_RESOLUTION = 16  # steps of the number type in a sweep of 0.1 s: 6 ms, 6 cm at 10 m/s
_FINE_STEP = 1e-3  # of a number type, in its own unit: coarser ones can make a column constant
_NEAR_SWEEPS = 2.0  # relative times, and absolute ones on the stamps' clock, lie within two sweeps of the stamp
_PIECE = 0.1  # of the usual number of points: a scan with fewer may be a piece of a sweep, and span as little
_OTHER_UNIT = (
    0.01  # of the usual span: units differ by 1000, and such a share of a sweep holds fewer points than a piece
)
_LONG = 1.2  # of the distance between stamps; of a lidar that turns, a sweep ends where the next one starts
_AT_END = 0.1  # of a sweep: the stamp is at its start, middle or end, with a gap of missing points


@dataclass(frozen=True)
class StatedTimes:
    """What a user states about point times; None where it is to be found.

    Attributes:
        column: name of the column.
        unit: a key of :data:`UNITS_NS`, or ``normalised``.
        origin: one of :data:`ORIGINS`, see :class:`PointTimes`.
        sweep_s: length of a sweep for normalised times; by default the distance between stamps.
        ignored: whether point times are not to be used.
    """

    column: str | None = None
    unit: str | None = None
    origin: str | None = None
    sweep_s: float | None = None
    ignored: bool = False


@dataclass(frozen=True)
class PointTimes:
    """The convention of a column of point times.

    Attributes:
        column: the column's name.
        unit_ns: nanoseconds of one unit; for normalised times the length of a sweep.
        origin: where the values count from. ``stamp``: the scan's stamp. ``absolute``: the origin of the stamps.
            ``start``, ``middle``, ``end``: the scan's stamp is the time of the sweep's first point, middle or last
            point, whatever the values count from.
        span_ns, points: of a usual scan, to know a scan by whose times are in another unit; 0 if unknown.
    """

    column: str
    unit_ns: int
    origin: str
    span_ns: int = field(default=0, compare=False)
    points: int = field(default=0, compare=False)

    def offsets_ns(self, columns: Columns, stamp_ns: int) -> Stamps:
        """Return the time of each point minus the scan's stamp, ``(N,)`` int64 nanoseconds.

        Args:
            columns: the scan's columns, of its valid points.
            stamp_ns: the scan's stamp.

        Raises:
            DataError: the column is missing, not finite, over 1 s from the stamp, or far shorter than in other scans.
        """
        if self.column not in columns:
            raise DataError(f"column '{self.column}' of the point times is missing; other scans have it")
        times = whole_ns(columns[self.column], self.unit_ns, self.column)
        if not len(times):
            return times
        first, last = int(times.min()), int(times.max())
        if len(times) > _PIECE * self.points and last - first < _OTHER_UNIT * self.span_ns:
            raise DataError(
                f"column '{self.column}' spans {last - first:,} ns in this scan and {self.span_ns:,} ns in others: "
                "its times are in another unit, or missing"
            )
        zero = {
            **{"stamp": 0, "absolute": stamp_ns},
            **{"start": first, "middle": (first + last) // 2, "end": last},
        }[self.origin]
        if max(abs(first - zero), abs(last - zero)) > _MAX_OFFSET_NS:
            raise DataError(
                f"column '{self.column}' is over 1 s from the scan's stamp ({(first - zero) / NS_PER_S:g} to "
                f"{(last - zero) / NS_PER_S:g} s)"
            )
        return times - zero if zero else times


def time_columns(names: Sequence[str]) -> list[str]:
    """Return those of the column names that mean a point's time, the most usual first."""
    known = [name.replace("_", "") for name in _NAMES]
    ranks = {name: known.index(base) for name in names if (base := _base(name)[0].replace("_", "")) in known}
    return sorted(ranks, key=lambda name: ranks[name])


def find_point_times(
    samples: Sequence[tuple[int, Columns]], step_ns: int | None, notes: Notes, stated: StatedTimes | None = None
) -> PointTimes | None:
    """Find the convention of a recording's point times; note it, or why a column is not used.

    Args:
        samples: stamp and columns of some scans, of their valid points.
        step_ns: median distance between the stamps of all scans; None if there is one scan.
        notes: receives one note per column.
        stated: what the user states.

    Returns:
        The convention, or None if the scans have no usable point times.

    Raises:
        DataError: no unit fits, or several do; the message says what to state.
    """
    stated = stated or StatedTimes()
    samples = [(stamp, columns) for stamp, columns in samples if all(map(len, columns.values()))]
    if stated.ignored or not samples:
        return None
    names = [stated.column] if stated.column else time_columns(list(samples[0][1]))
    for name in names:
        found = [(stamp, columns[name]) for stamp, columns in samples if name in columns]
        if not found:
            raise DataError(f"point_times: no column '{name}'; the columns are {', '.join(samples[0][1])}")
        values = readable(name, found)
        fault = _fault([column for _, column in values])
        if fault is None:
            return _convention(name, values, step_ns, notes, stated)
        notes.add(f"point times: column '{name}' {fault}; not used")
    if not names:
        note_likely(samples, step_ns, notes)
    return None


def _base(name: str) -> tuple[str, str | None]:
    """Return a column's name in lower case without the suffix of a unit, and that unit."""
    name = name.lower()
    suffix = next((s for s in sorted(_SUFFIXES, key=len, reverse=True) if name.endswith(s)), None)
    return (name.removesuffix(suffix), _SUFFIXES[suffix]) if suffix else (name, None)


def _fault(columns: list[NDArray[Any]]) -> str | None:
    """Return why a column cannot be point times, or None."""
    # the median: a damaged scan must not decide
    largest = float(np.median([np.abs(values.astype(np.float64)).max() for values in columns]))
    span = _span(columns)
    if largest == 0:
        return "holds zeros only"
    step = float(np.spacing(np.asarray(largest, columns[0].dtype))) if columns[0].dtype.kind == "f" else 0.0
    if span <= _MIN_RESOLUTION * step and (span or step > _FINE_STEP):
        return f"is {columns[0].dtype} at {largest:.3g} and has steps of {step:g}, too coarse; write it as float64"
    return None if span else f"is constant ({largest:g})"


def _span(columns: list[NDArray[Any]]) -> float:
    """Return the median span of the columns that are not constant; 0 if all are."""
    spans = [float(values.max().item() - values.min().item()) for values in columns]
    return float(np.median([span for span in spans if span] or [0.0]))


def _convention(
    name: str, values: list[tuple[int, NDArray[Any]]], step_ns: int | None, notes: Notes, stated: StatedTimes
) -> PointTimes:
    unit, unit_ns = _unit(name, [column for _, column in values], step_ns, stated)
    ends, offsets, errors = [], [], []
    for stamp, column in values:
        try:
            ns = whole_ns(column, unit_ns, name)
            ends.append((stamp, int(ns.min()), int(ns.max())))
        except DataError as error:
            errors.append(error)
    if not ends:
        raise errors[0]
    origin = stated.origin or _origin(ends, step_ns)
    span_ns = int(np.median([last - first for _, first, last in ends]))
    if step_ns is not None and span_ns > _LONG * step_ns:
        notes.add(
            f"point times: column '{name}' in {unit} spans {span_ns / 1e6:.0f} ms, over the {step_ns / 1e6:.0f} ms "
            "between scans; check its unit and the rate of the scans"
        )
    found = PointTimes(name, unit_ns, origin, span_ns, int(np.median([len(column) for _, column in values])))
    for stamp, column in values:
        try:
            offsets.append(found.offsets_ns({name: column}, stamp))
        except DataError as error:
            errors.append(error)
    if 2 * len(offsets) <= len(values):
        raise errors[0]
    if len(offsets) < len(values):
        notes.add(f"point times: in {len(values) - len(offsets)} of {len(values)} scans looked at, {errors[0]}")
    first, last = (float(np.median([end(ns) for ns in offsets])) for end in (np.min, np.max))
    apart_s = float(np.median([lo - stamp for stamp, lo, _ in ends])) / NS_PER_S
    texts = {"stamp": "from the scan's stamp", "absolute": "on the stamps' clock"}
    text = f"point times: column '{name}' in {unit} {texts.get(origin, f'with the stamp at the {origin} of the sweep')}"
    text += f", {first / 1e6:.1f} to {last / 1e6:.1f} ms{_place(first, last)}"
    if origin == "start" and stated.origin is None:
        notes.add(
            f"{text}; the values are {apart_s:+.3f} s from the stamps, so another clock. If the stamp is not at the "
            "start of the sweep, state 'point_times: {origin: middle}' or 'end' in calibration.yaml"
        )
    else:
        notes.found(text)
    return found


def _unit(name: str, columns: list[NDArray[Any]], step_ns: int | None, stated: StatedTimes) -> tuple[str, int]:
    """Return name and nanoseconds of the only unit in which the columns span a sweep."""
    sweep_ns = round(stated.sweep_s * NS_PER_S) if stated.sweep_s else step_ns
    units = UNITS_NS | ({NORMALISED: min(sweep_ns, _MAX_OFFSET_NS)} if sweep_ns else {})
    if stated.unit is not None:
        if stated.unit not in units:
            raise DataError("point_times: normalised times of a single scan need 'sweep_s', the length of a sweep")
        return stated.unit, units[stated.unit]
    suffix = _base(name)[1]
    if suffix is not None:
        return suffix, UNITS_NS[suffix]
    span = _span(columns)
    limit = _USUAL_SWEEP_NS if step_ns is None else min(_MAX_SWEEP_IN_STEPS * step_ns, _MAX_SWEEP_NS)
    fitting = [unit for unit, ns in UNITS_NS.items() if _MIN_SWEEP_NS <= span * ns <= limit]
    if _is_normalised(columns):
        fitting.append(NORMALISED)
    apart = "" if step_ns is None else f", scans are {step_ns / 1e6:g} ms apart"
    if len(fitting) != 1:
        can = " or ".join(fitting) or "none of s, ms, us and ns"
        raise DataError(f"column '{name}' spans {span:g} in a scan{apart}: its unit can be {can}; {HOW_TO_STATE}")
    if fitting[0] not in units:
        raise DataError(
            f"column '{name}' holds shares of a sweep whose length is unknown; {HOW_TO_STATE}, with 'sweep_s'"
        )
    return fitting[0], units[fitting[0]]


def _is_normalised(columns: list[NDArray[Any]]) -> bool:
    """Return whether the columns hold shares of a sweep: floating-point numbers from 0 to 1."""
    return all(
        values.dtype.kind == "f" and values.min() >= 0 and np.ptp(values) >= _FULL_SHARE and values.max() <= 1 + 1e-6
        for values in columns
    )


def _origin(ends: list[tuple[int, int, int]], step_ns: int | None) -> str:
    """Return what times count from, given stamp, first and last time of some scans in nanoseconds."""
    spans = [last - first for _, first, last in ends]
    sweep_ns = max(float(np.median(spans)), min(step_ns or 0, _MAX_OFFSET_NS))  # a scan may hold a part of the sweep
    relative = float(np.median([max(abs(first), abs(last)) for _, first, last in ends]))
    absolute = float(np.median([max(abs(first - stamp), abs(last - stamp)) for stamp, first, last in ends]))
    if min(relative, absolute) > _NEAR_SWEEPS * sweep_ns:
        return "start"
    return "stamp" if relative <= absolute else "absolute"


def _place(first_ns: float, last_ns: float) -> str:
    """Describe where in the sweep the stamp lies, for a note."""
    margin = _AT_END * (last_ns - first_ns)
    places = {"start": first_ns, "middle": (first_ns + last_ns) / 2, "end": last_ns}
    near = [name for name, at in places.items() if abs(at) <= margin]
    return f" (the stamp is the sweep's {near[0]})" if near else " (the stamp is at no usual place of the sweep)"
