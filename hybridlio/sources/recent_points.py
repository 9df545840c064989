"""Points of the last second together, for lidars that do not repeat their pattern from scan to scan.

One scan of such a lidar is a set of arcs or scattered points with gaps between them. Neighbours within it often lie on
one arc, and a plane fitted to them leans. Scans of a second fill the gaps. So keyframes of the map are made of the last
scans, each at the pose where it was matched. A spinning lidar measures in the same directions in every scan, and its
scans do not need each other.
"""

from __future__ import annotations

import numpy as np

from hybridlio.cloud.voxel import voxel_average
from hybridlio.core import se3
from hybridlio.core.arrays import Array, Floats, Index
from hybridlio.core.sensors import Scan

# A lidar repeats its pattern if more than this share of a scan's points lie in directions, in cells of this size, that
# occur in the scan before. Real spinning lidars have 0.76 (KITTI's, whose scans are compensated) to 0.99, simulated
# ones 0.9 or more, and about half of that where half of the points are anywhere; those that do not repeat have 0.1 to
# 0.3. In cells of a degree 20,000 points within 360° × 59°, or within 70°, share half or all of them by chance. Finer
# cells are too fine for lidars whose turns start anywhere: their columns are 0.2° to 0.4° apart.
_REPEATED_SHARE, _CELL_DEG = 0.45, 0.25
# Of compensated scans: while the lidar turns, their directions repeat less well.
_COARSE_CELL_DEG = 1.0
# Rows of a spinning lidar are fixed, so scans that were thinned at random share elevations where they share no
# directions. Cells much finer than the rows' spacing, 0.35° with 128 rows over 45°, leave most elevations empty, while
# a lidar without rows fills them as evenly as chance does.
_ROW_CELL_DEG, _MOST_FILLED = 0.1, 0.5
# Of a scan from which the pattern is learned. Shares of 100 points have standard deviations of 0.05, a third of what
# lies between the limit and the shares of either kind of lidar.
FEWEST_POINTS = 100
_SCANS = 10  # one second at 10 Hz, in which patterns cover most of their field of view


class RecentPoints:
    """Collects the points of the last scans; starts empty.

    Args:
        repeats: whether the lidar repeats its pattern; None to learn it from the first two scans.
    """

    def __init__(self, repeats: bool | None = None) -> None:
        self._directions: Index | None = None  # of the first scan, until the second has come
        self._repeats = self._told = repeats
        self._recent: list[tuple[Array, Array]] = []

    @property
    def repeats(self) -> bool:
        """Whether the lidar repeats its pattern, as far as is known."""
        return self._repeats is not False

    @property
    def is_filling(self) -> bool:
        """Whether scans fill each other's gaps, and there are still few of them."""
        return self._repeats is False and len(self._recent) < _SCANS

    def observe(self, scan: Scan) -> None:
        """Learn from the first two scans with enough points, compensated as they are, whether the pattern repeats."""
        if self._repeats is not None or len(scan) < FEWEST_POINTS:
            return
        directions, before = _directions(scan.points, _COARSE_CELL_DEG), self._directions
        self._directions = np.unique(directions)
        if before is not None:
            self._repeats = _repeats(before, directions)
            self._directions = None

    def tell(self, repeats: bool) -> None:
        """Set whether the lidar repeats its pattern, as is known from scans as they were recorded."""
        self._repeats = self._told = repeats

    def emptied(self) -> RecentPoints:
        """Return a collection without points, which knows what this one was told."""
        return RecentPoints(self._told)

    def add(self, points: Array, T_map_lidar: Array) -> None:
        """Add the points ``(N, 3)`` of a scan that was matched at a pose ``(4, 4)``."""
        if not self._repeats:
            self._recent = [*self._recent, (points, T_map_lidar)][-_SCANS:]

    def discard_last(self) -> None:
        """Discard the scan added last."""
        self._recent = self._recent[:-1]

    def together(self, points: Array, T_map_lidar: Array, voxel_m: float) -> Array:
        """Return the points ``(N, 3)`` of the scan at a pose, filled up by the scans before, one a voxel."""
        if self._repeats is not False or not self._recent:
            return points
        T_lidar_map = se3.inverse(T_map_lidar)
        everything = [se3.transform(T_lidar_map @ pose, earlier) for earlier, pose in self._recent]
        return np.asarray(voxel_average(np.concatenate(everything), None, voxel_m)[0], np.float64)


def repeats_directions(earlier: Scan, later: Scan) -> bool:
    """Return whether a lidar measures in about the same directions in two consecutive scans."""
    has_times = earlier.time_offsets_ns is not None and later.time_offsets_ns is not None
    cell_deg = _CELL_DEG if has_times else _COARSE_CELL_DEG
    return _repeats(np.unique(_directions(earlier.points, cell_deg)), _directions(later.points, cell_deg))


def repeats_rows(earlier: Scan, later: Scan) -> bool:
    """Return whether a lidar measures in about the same rows, whatever the directions in them, in two scans."""
    rows = np.unique(_rows(earlier.points))
    by_chance = len(rows) / (np.ptp(rows) + 1) if len(rows) else 1.0
    return by_chance < _MOST_FILLED and _repeats(rows, _rows(later.points), by_chance)


def _repeats(before: Index, cells: Index, by_chance: float = 0.0) -> bool:
    """Return whether the cells of most points occur before, of those that would not do so by chance.

    Points are counted, not cells: noise puts each of its points into a cell of its own.
    """
    shared = int(np.isin(cells, before).sum())
    return shared - by_chance * len(cells) > _REPEATED_SHARE * (1 - by_chance) * len(cells)


def _rows(points: Floats) -> Index:
    """Return the cell ``(N,)`` of each point's elevation."""
    x, y, z = points.T.astype(np.float64)
    return np.asarray(np.rint(np.degrees(np.arctan2(z, np.hypot(x, y))) / _ROW_CELL_DEG).astype(np.int64))


def _directions(points: Array | Floats, cell_deg: float) -> Index:
    """Return the cell ``(N,)`` of each point's direction.

    Beams at whole degrees lie in the middle of their cells.
    """
    x, y, z = points.T.astype(np.float64)
    cells = np.rint(np.degrees([np.arctan2(z, np.hypot(x, y)), np.arctan2(y, x)]) / cell_deg).astype(np.int64)
    return np.asarray(cells[0] * 10_000 + cells[1])
