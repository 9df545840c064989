"""Reference poses brought to the stamps of the scans."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybridlio.core import se3
from hybridlio.core.trajectory import Trajectory
from hybridlio.datasets.sequence import Notes

_MAX_AWAY_NS = 250_000_000


def poses_at(
    at_ns: NDArray[np.int64], stamps_ns: NDArray[np.int64], poses: NDArray[np.float64], what: str, notes: Notes
) -> Trajectory | None:
    """Poses at ``at_ns`` ``(N,)`` in the frame of the first, on the geodesics between ``poses`` ``(R, 4, 4)``.

    Goes on at constant twist beyond the ends. None, with a note that calls the poses ``what``, where one of ``at_ns``
    lies more than 0.25 s from the nearest of ``stamps_ns`` ``(R,)``: outside them, or in a gap.
    """
    if len(stamps_ns) < 2:
        notes.add(f"no reference poses: fewer than two {what}")
        return None
    right = np.clip(np.searchsorted(stamps_ns, at_ns), 1, len(stamps_ns) - 1)
    before, after = stamps_ns[right - 1], stamps_ns[right]
    away = np.minimum(np.abs(at_ns - before), np.abs(at_ns - after))
    if away.max() > _MAX_AWAY_NS:
        far = int(away.argmax())
        notes.add(f"no reference poses: scan {far} lies {away[far] / 1e9:.2f} s from the nearest of the {what}")
        return None
    fraction = (at_ns - before) / (after - before)
    return Trajectory(at_ns, se3.interpolate(poses[right - 1], poses[right], fraction)).from_first()
