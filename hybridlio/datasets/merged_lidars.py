"""Scans of several lidars on one body, merged: each of the first one with those of the others nearest in time."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Stamps
from hybridlio.core.errors import DataError
from hybridlio.core.sensors import NS_PER_S, Scan
from hybridlio.core.tables import counted
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.points.point_format import Box

_log = logging.getLogger(__name__)

_FARTHEST_STEPS = 0.75  # of the first lidar's: a scan between two of its scans is at most half a step from one of them


@dataclass(frozen=True, eq=False)
class OtherLidar:
    """Another lidar than the first.

    Attributes:
        name: for messages.
        load: loads its scan ``k``.
        stamps_ns: ``(M,)`` of its scans.
        T_first_other: ``(4, 4)``, maps its points into the frame of the first lidar.
        scan_of: ``(M,)`` the first lidar's scan that each of its scans is merged into, -1 for none.
    """

    name: str
    load: Callable[[int], Scan]
    stamps_ns: Stamps
    T_first_other: Array
    scan_of: Stamps


@dataclass(frozen=True, eq=False)
class MergedScans:
    """Loads scan ``k`` of the first lidar with those of the others. An object, so that it can be pickled.

    Points of other lidars keep their own times, so motion compensation moves each one from when it was measured. Scans
    without times of points count as measured at their stamps.

    Attributes:
        load: loads scan ``k`` of the first lidar.
        others: the other lidars.
        vehicle: a box in the frame of the first lidar, in which points of the others are left out.
    """

    load: Callable[[int], Scan]
    others: tuple[OtherLidar, ...]
    vehicle: Box | None = None

    def __call__(self, k: int) -> Scan:
        """Load scan ``k``; scans of other lidars that cannot be read are left out with a warning.

        Raises:
            DataError: the first lidar's scan cannot be read.
        """
        first = self.load(k)
        parts, shifts = [first], [0]
        for other in self.others:
            for row in np.flatnonzero(other.scan_of == k).tolist():
                try:
                    scan = other.load(row)
                except DataError as error:
                    _log.warning("%s is left out of scan %d: %s", other.name, k, error)
                    continue
                parts.append(self._moved(scan, other.T_first_other))
                shifts.append(scan.stamp_ns - first.stamp_ns)
        return first if len(parts) == 1 else _joined(first.stamp_ns, parts, shifts)

    def _moved(self, scan: Scan, T_first_other: Array) -> Scan:
        points = se3.transform(T_first_other, scan.points).astype(np.float32)
        moved = replace(scan, points=points)
        return moved if self.vehicle is None else moved.part(~self.vehicle.holds(points))


def _joined(stamp_ns: int, parts: list[Scan], shifts_ns: list[int]) -> Scan:
    intensities = [np.zeros(len(s), np.float32) if s.intensity is None else s.intensity for s in parts]
    offsets = [
        np.full(len(s), shift) if s.time_offsets_ns is None else s.time_offsets_ns + shift
        for s, shift in zip(parts, shifts_ns, strict=True)
    ]
    return Scan(
        stamp_ns,
        np.concatenate([s.points for s in parts]),
        np.concatenate(intensities) if any(s.intensity is not None for s in parts) else None,
        np.concatenate(offsets) if any(s.time_offsets_ns is not None for s in parts) or any(shifts_ns) else None,
    )


def nearest_scans(first_ns: Stamps, other_ns: Stamps, name: str, notes: Notes) -> Stamps:
    """Return the scan of the first lidar that each scan of another one is nearest to, ``(M,)``; -1 where none is near.

    Every scan of the other lidar goes into one scan at most, whatever the rates.

    Args:
        first_ns: ``(N,)`` stamps of the first lidar, increasing.
        other_ns: ``(M,)`` stamps of the other one.
        name: of the other one.
        notes: receives what is merged, and what is left out.

    Raises:
        DataError: no scan of the other lidar is near one of the first.
    """
    after = np.clip(np.searchsorted(first_ns, other_ns), 1, max(len(first_ns) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(first_ns) - 1)
    is_after = np.abs(first_ns[after] - other_ns) < np.abs(first_ns[before] - other_ns)
    nearest = np.where(is_after, after, before)
    step_ns = float(np.median(np.diff(first_ns))) if len(first_ns) > 1 else NS_PER_S / 10
    apart = np.abs(first_ns[nearest] - other_ns)
    near = apart <= _FARTHEST_STEPS * step_ns
    if not near.any():
        raise DataError(
            f"{name}: no scan is within {_FARTHEST_STEPS * step_ns / 1e6:.0f} ms of one of the first lidar; the "
            "clocks of the lidars must be one"
        )
    notes.found(
        f"{name}: {counted(int(near.sum()), 'scan')} merged into those of the first lidar, "
        f"{np.median(apart[near]) / 1e6:.0f} ms apart in the median"
    )
    if not near.all():
        notes.add(f"{name}: {counted(int((~near).sum()), 'scan')} far from all scans of the first lidar, left out")
    return np.where(near, nearest, -1)
