"""The cells of a map that fit an unknown lidar, from one of its scans."""

from __future__ import annotations

import numpy as np

from hybridlio.cloud.map_geometry import MapGeometry
from hybridlio.cloud.projection import normal_map, vertex_map
from hybridlio.core.arrays import Floats

_ROWS = (8, 12, 16, 20, 24, 32, 40, 48, 52, 64, 80, 96, 128)  # numbers of beams that are built, and some between
_COLUMNS = (720, 480, 360)  # from that of the shipped weights down: sparse scans leave gaps between narrow cells
_OUTLIERS_PERCENT = 0.5  # of the elevations on either side: stray returns, such as reflections


def fitting_geometry(points: Floats) -> MapGeometry | None:
    """Return the cells in which most points of a scan have a normal; None where no cell has one.

    A normal needs the four neighbours of a cell. With more rows than beams there are gaps between the rows, with fewer
    there are fewer cells: the number of normals is largest where each beam has a row.

    Args:
        points: ``(N, 3)`` metres, lidar frame.
    """
    ranges_m = np.linalg.norm(points, axis=1)
    points, ranges_m = points[ranges_m > 0], ranges_m[ranges_m > 0]
    if not len(points):
        return None
    elevations = np.degrees(np.arcsin(points[:, 2] / ranges_m))
    bottom, top = np.percentile(elevations, [_OUTLIERS_PERCENT, 100 - _OUTLIERS_PERCENT])
    found = [_spanning(float(bottom), float(top), rows, columns) for rows in _ROWS for columns in _COLUMNS]
    counts = [int(normal_map(vertex_map(points, cells)).any(axis=0).sum()) for cells in found]
    best = int(np.argmax(counts))
    return found[best] if counts[best] else None


def _spanning(bottom_deg: float, top_deg: float, rows: int, columns: int) -> MapGeometry:
    """Return rows whose first and last have the elevations in their middle."""
    half = max((top_deg - bottom_deg) / (rows - 1) / 2, 0.01)
    return MapGeometry(min(top_deg + half, 90.0), max(bottom_deg - half, -90.0), rows, columns)
