"""Columns that may hold the times of points although their names do not say so: they are named, and not used.

Some drivers and tools write times under other names, such as ``curvature``, or as the lower half of 64 bits. Such a
column spans the time between two scans in every scan, and hardly changes from point to point, as points are written in
the order in which they were measured. Neither holds for intensities.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridlio.core.arrays import NS_PER_S
from hybridlio.datasets.notes import Notes

_PARTS = ("time", "stamp", "offset", "delta", "nsec", "usec")  # of names that may mean a time
_NOT_TIMES = frozenset(
    {
        *(
            "x",
            "y",
            "z",
            "ring",
            "line",
            "laser_id",
            "channel",
            "row",
            "column",
            "azimuth",
            "range",
            "distance",
            "depth",
        ),
        *("intensity", "reflectivity", "reflectance", "remission", "ambient", "noise"),
    }
)
_UNITS_NS = (NS_PER_S, 1_000_000, 1000, 1)
_SWEEP = (0.9, 1.02)  # of the distance between stamps: a sweep of a lidar that turns, with a gap of missing points
_SMALL = 0.05  # of the span: a step from point to point, for all but a few that begin another beam


def note_likely(samples: Sequence[tuple[int, Mapping[str, NDArray[Any]]]], step_ns: int | None, notes: Notes) -> None:
    """Note columns whose names or values are like times.

    Args:
        samples: stamp and columns of some scans.
        step_ns: median distance between the stamps of all scans; None if there is one scan.
        notes: receives the note.
    """
    names = list(samples[0][1])
    likely = [name for name in names if any(part in name.lower() for part in _PARTS)]
    if not likely and step_ns is not None:
        likely = [name for name in names if name.lower() not in _NOT_TIMES and _spans_sweeps(name, samples, step_ns)]
    if likely:
        notes.add(
            f"point times: {' or '.join(repr(name) for name in likely)} may hold them, and is not used; "
            f"'point_times: {{column: {likely[0]}}}' in calibration.yaml uses it"
        )


def _spans_sweeps(name: str, samples: Sequence[tuple[int, Mapping[str, NDArray[Any]]]], step_ns: int) -> bool:
    """Return whether a column spans a sweep, and hardly changes from point to point, in every scan."""
    columns = [columns[name].astype(np.float64) for _, columns in samples if name in columns]
    spans = np.array([np.ptp(values) for values in columns])
    if not np.isfinite(spans).all() or not spans.all():
        return False
    smooth = all(np.mean(np.abs(np.diff(v)) < _SMALL * s) > 1 - _SMALL for v, s in zip(columns, spans, strict=True))
    shares = [spans * unit_ns / step_ns for unit_ns in _UNITS_NS]
    return smooth and any(((share > _SWEEP[0]) & (share < _SWEEP[1])).all() for share in shares)
