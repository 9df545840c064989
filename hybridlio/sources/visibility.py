"""Scans from inside a cloud of dust, smoke or spray, which show the cloud and hide the scene.

Inside a cloud most light is lost, and what returns comes from the air around the lidar. These returns move along with
it: registered to those of the scan before, they say that nothing moves. The scene is behind them, so such a scan says
nothing, and the IMU is to be believed alone. Entering a cloud, a lidar loses most of its returns *and* sees less far,
both from one scan to the next few. In a narrow passage it sees less far and gets all its returns; something before it
takes returns and leaves the view of the rest.
"""

from __future__ import annotations

import numpy as np

from hybridlio.core.sensors import NS_PER_S, Scan
from hybridlio.sources.settings import STREET_VIEW_M

# Of the usual number of returns, and of the usual view. Inside simulated clouds they are 0.13 to 0.47 and 0.23 to 0.54
# (benchmarks/point_removal.py, dust, seeds 8191 and 8192). In 34 recordings of other platforms one of both is 1.2 times
# these bounds or more, in drives without dust and in real recordings 1.4 times.
_LOST = np.log([0.5, 0.6])
# In a narrow stairwell, walls nearer than a lidar's least range take returns and view alike.
_WIDE_VIEW_M = STREET_VIEW_M / 2
_MEMORY_SCANS = 20  # as the memory of how well scans fit the map: 2 s at 10 Hz, in which a scene changes
_LONGEST_S = 3.0  # afterwards it is the scene that has changed, or the IMU has drifted as far as poor matches would


class Visibility:
    """Learns from the scans how much a lidar usually sees, and tells which ones see the air alone."""

    def __init__(self) -> None:
        self._usual: tuple[float, float] | None = None  # logarithms of the returns and of the view
        self._last_clear_ns = 0

    def is_lost(self, scan: Scan, view_m: float) -> bool:
        """Take the next scan, and return whether the air hides the scene from it.

        Args:
            scan: with all its points.
            view_m: median range of its points averaged over voxels.
        """
        if not view_m > 0:
            return False
        seen = float(np.log(len(scan))), float(np.log(view_m))
        usual = self._usual or seen
        is_lost = usual[1] > np.log(_WIDE_VIEW_M) and bool(np.all(np.subtract(seen, usual) < _LOST))
        if is_lost and scan.stamp_ns - self._last_clear_ns < _LONGEST_S * NS_PER_S:
            return True
        memory = 1 if is_lost else _MEMORY_SCANS
        self._usual = (usual[0] + (seen[0] - usual[0]) / memory, usual[1] + (seen[1] - usual[1]) / memory)
        self._last_clear_ns = scan.stamp_ns
        return False
