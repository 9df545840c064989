"""A map as a cloud of points with what is known of each."""

from __future__ import annotations

from collections.abc import Sequence as Items
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from hybridlio.core.arrays import Array, Floats


@dataclass(frozen=True, eq=False)
class PointMap:
    """Points in the world frame, one for each voxel, with ``N`` rows in every array.

    Attributes:
        points: ``(N, 3)`` float64, metres.
        intensity: ``(N,)`` float32, mean reflectance from 0 to 1; None if the scans have none.
        normals: ``(N, 3)`` float32 unit normals towards the lidar, zero where a point has too few neighbours; None if
            they were not asked for.
        first_s, last_s: ``(N,)`` float32, the first and the last time that a scan hit the voxel, since the first scan.
        scans: ``(N,)`` uint16, number of scans that hit it.
    """

    points: Array
    intensity: Floats | None
    normals: Floats | None
    first_s: Floats
    last_s: Floats
    scans: np.ndarray

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        if not len(self):
            return "PointMap(0 points)"
        low, high = self.points.min(axis=0), self.points.max(axis=0)
        return f"PointMap({len(self)} points, {' x '.join(f'{side:.1f}' for side in high - low)} m)"

    @classmethod
    def joined(cls, parts: Items[PointMap]) -> PointMap:
        """Return the points of several maps as one; an array that one of them lacks is None."""
        joined: dict[str, Any] = {}
        for name in (f.name for f in fields(cls)):
            values = [getattr(part, name) for part in parts]
            joined[name] = None if any(value is None for value in values) else np.concatenate(values)
        return cls(**joined)
