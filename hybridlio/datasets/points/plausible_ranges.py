"""Whether the ranges of points are those of a lidar: in metres, and from the lidar itself."""

from __future__ import annotations

import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.datasets.notes import Notes

NO_LIDARS_MEDIAN = 500.0  # m; of a scan from the ground it is 5 to 20 m, and few lidars see so far at all
_MAX_NEAREST_M = 30.0  # to the nearest hundredth of the points; 3 to 6 m on roads
_MAX_MAP_KM = 200.0  # of a median: beyond, no lidar's millimetres reach


def check_ranges(ranges: list[Array], largest_m: float, notes: Notes) -> None:
    """Refuse clouds in a map's frame, such as UTM, or in millimetres; note those that may be.

    Args:
        ranges: ``(N,)`` of the points of some scans, in what is taken for metres.
        largest_m: beyond the range of any lidar.
        notes: receives what is doubtful.

    Raises:
        DataError: most points of most clouds are beyond the range of any lidar.
    """
    ranges = [of_scan for of_scan in ranges if len(of_scan)]
    if not ranges:
        return
    middle = float(np.median([np.median(of_scan) for of_scan in ranges]))
    nearest = float(np.median([np.quantile(of_scan, 0.01) for of_scan in ranges]))
    if middle > largest_m:
        or_mm = "in millimetres (divide them by 1000), or " if middle < 1000 * _MAX_MAP_KM else ""
        raise DataError(
            f"points are {middle / 1000:.0f} km from the origin, as {or_mm}in a map's frame (UTM); they must be in "
            "the lidar's: transform each scan by the inverse of its pose"
        )
    if middle > NO_LIDARS_MEDIAN:
        notes.add(f"points are {middle:.0f} m from the lidar in the median: if that is not so, they are not in metres")
    elif nearest > _MAX_NEAREST_M:
        notes.add(
            f"nearly no point is nearer to the lidar than {nearest:.0f} m: if that is not so, the points are in a "
            "map's frame, and each scan must be transformed by the inverse of its pose"
        )
