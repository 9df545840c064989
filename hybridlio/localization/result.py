"""The result of a localisation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridlio.core.arrays import Array
from hybridlio.core.trajectory import Trajectory
from hybridlio.runs.run import Run


@dataclass(frozen=True, eq=False)
class Localization:
    """A run in a map.

    Attributes:
        trajectory: ``N`` lidar poses ``T_map_lidar`` with covariances. Those before the place was found are the
            odometry's, joined to the first one that was.
        held: ``(N,)`` whether the map held the pose; else odometry carried it on from the last one held.
        matched: ``(N,)`` share of each scan's points with a surface of the map nearby; NaN where it was not matched.
        cost: ``(N,)`` mean robust cost of the points, 0 to 1; NaN likewise.
        found: row at which the map first held the pose.
        run: the odometry's run.
    """

    trajectory: Trajectory
    held: NDArray[np.bool_]
    matched: Array
    cost: Array
    found: int
    run: Run

    def __repr__(self) -> str:
        return (
            f"Localization({len(self.trajectory)} poses, found at scan {self.found}, "
            f"{self.held.mean():.0%} held by the map)"
        )
