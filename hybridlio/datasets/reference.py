"""Reference poses, interpolated at the stamps of the scans."""

from __future__ import annotations

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Stamps
from hybridlio.core.sensors import NS_PER_S
from hybridlio.core.trajectory import Trajectory
from hybridlio.datasets.notes import Notes

# At 2 m/s² a constant twist is off by 6 cm after 0.25 s: little for a reference, but growing fast.
_MAX_DISTANCE_NS = 250_000_000


def poses_at(at_ns: Stamps, stamps_ns: Stamps, poses: Array, what: str, notes: Notes) -> Trajectory | None:
    """Interpolate poses along geodesics of SE(3), and extrapolate at constant twist beyond the ends.

    Args:
        at_ns: ``(N,)`` the stamps of the result.
        stamps_ns: ``(R,)`` the stamps of ``poses``, strictly increasing.
        poses: ``(R, 4, 4)``.
        what: name of the poses' rows, for the note.
        notes: receives the reason if the result is None.

    Returns:
        Poses at ``at_ns``, in the frame of the first; None if one of ``at_ns`` is over 0.25 s from the nearest of
        ``stamps_ns``, or there are fewer than two poses.
    """
    if len(stamps_ns) < 2:
        notes.add(f"no reference poses: fewer than two {what}")
        return None
    right = np.clip(np.searchsorted(stamps_ns, at_ns), 1, len(stamps_ns) - 1)
    before, after = stamps_ns[right - 1], stamps_ns[right]
    distance_ns = np.minimum(np.abs(at_ns - before), np.abs(at_ns - after))
    if distance_ns.max() > _MAX_DISTANCE_NS:
        far = int(distance_ns.argmax())
        notes.add(
            f"no reference poses: scan {far} is {distance_ns[far] / NS_PER_S:.2f} s from the nearest of the {what}"
        )
        return None
    fraction = (at_ns - before) / (after - before)
    return Trajectory(at_ns, se3.interpolate(poses[right - 1], poses[right], fraction)).from_first()
