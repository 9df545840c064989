"""Point-to-point matches where a surface has no plane: trunks, bushes, leaves.

A plane fitted to ten points on a trunk has an arbitrary normal, and distances to it are accurate to a decimetre at
best. Two scans that hit the same trunk have points within centimetres of each other, in all three directions. So for a
thick plane the residual is the whole difference to the neighbour, in the scan's frame (rotating it does not change its
length):

    ``r(ξ) = Rᵀ(T·Exp(ξ)·p − q)``,  ``∂r/∂ω = −[p]ₓ``,  ``∂r/∂v = I``  at ``ξ = 0``.

The kernel is over the length of the difference. One kernel per component would accept a chance neighbour that is near
in one direction and far in another.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.registration.information import lever_arms
from hybridlio.registration.surface import Neighbours, PlaneMatches

if TYPE_CHECKING:
    from hybridlio.registration.loops import Rows, Sums


@dataclass(frozen=True, eq=False)
class MixedMatches:
    """Scan points matched with planes where those are thin, else with points.

    Attributes:
        planes: matches with planes.
        source: ``(M, 3)`` the points that are matched with points, scan frame.
        rows: derivatives and distances of both; differences of points are in the scan frame.
    """

    planes: PlaneMatches
    source: Array
    rows: Rows

    @classmethod
    def linearised(cls, planes: PlaneMatches, source: Array, targets: Array, weights: Array) -> MixedMatches:
        """Compute differences to ``targets`` ``(M, 3)`` and their derivatives at the pose of ``planes``."""
        x, y, z = source.T
        rows = np.zeros((7, 3, len(source)))
        rows[0, 1], rows[0, 2] = -z, y
        rows[1, 0], rows[1, 2] = z, -x
        rows[2, 0], rows[2, 1] = -y, x
        rows[3, 0] = rows[4, 1] = rows[5, 2] = 1.0
        rows[6] = (source + (planes.pose[:3, 3] - targets) @ planes.pose[:3, :3]).T
        return cls(planes, source, planes.rows._replace(points=rows, point_weights=weights))

    def __len__(self) -> int:
        return len(self.planes) + len(self.source)

    @property
    def lever_arms_m(self) -> Array:
        """``(3,)`` of all points about the scan's axes, see :func:`hybridlio.registration.information.lever_arms`."""
        return lever_arms(np.concatenate([self.planes.source, self.source]))

    def system(self, kernel_m: float, xi: Array | None = None) -> Sums:
        """Return the step's least squares, like :meth:`hybridlio.registration.surface.PlaneMatches.system`.

        The kernel takes the weighted squared difference, so it is wider for a thick neighbourhood, whose points
        scatter.
        """
        from hybridlio.registration import loops  # late: compiled

        return loops.system(self.rows, np.zeros(6) if xi is None else xi, kernel_m, kernel_m)


class MixedNeighbours(Neighbours):
    """Neighbours that are matched as planes or as points, depending on the plane's weight."""

    def mixed(self, pose: Array, max_distance_m: float) -> MixedMatches:
        """Match the points at a pose; points without a neighbour within ``max_distance_m`` are left out."""
        from hybridlio.registration.match_loops import THIN_PLANE_WEIGHT  # late: compiled

        index, source = self.within(pose, max_distance_m)
        planes = self.surface.planes(index)
        flat = planes[:, 4] >= THIN_PLANE_WEIGHT
        targets = self.surface.points.take(index[~flat], axis=0)
        plane_matches = PlaneMatches.linearised(pose, source[flat], planes[flat])
        return MixedMatches.linearised(plane_matches, source[~flat], targets, planes[~flat, 4])
