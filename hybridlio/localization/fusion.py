"""The pose in a map: predicted by odometry, and fused with matches to the map.

The errors of consecutive matches are not independent: they see the same stretch of the map, whose points are wrong in
the same way. A Kalman filter would average them away and soon believe itself exact. Covariance intersection assumes
nothing about their dependence, and its covariance is never smaller than it should be (Julier, Uhlmann, "A
non-divergent estimation algorithm in the presence of unknown correlations", ACC 1997).

``benchmarks/localization_fusion.py`` compares it with a graph that has the matches as factors: in two simulated towns
the graph is no more accurate, and its ANEES is 4 to 7 times as large in position.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array

_SHARES = np.linspace(0.0, 1.0, 11)  # of the prediction; the determinant is flat about its minimum


@dataclass(frozen=True, eq=False)
class UncertainPose:
    """A lidar pose in the map.

    Attributes:
        pose: ``(4, 4)`` ``T_map_lidar``.
        covariance: ``(6, 6)`` of a right perturbation, rad² and m², rotation first.
    """

    pose: Array
    covariance: Array

    @property
    def sigma_m(self) -> float:
        """Standard deviation of the position, all axes together."""
        return float(np.sqrt(self.covariance[3:, 3:].trace()))

    def moved(self, step: Array, covariance: Array) -> UncertainPose:
        """Return the pose after a step ``T_k_k1`` ``(4, 4)`` with a covariance."""
        return UncertainPose(self.pose @ step, se3.compose_covariance(self.covariance, step, covariance))

    def chi2(self, other: UncertainPose) -> float:
        """Return χ² of the difference to another pose of the same scan, with independent errors."""
        error = se3.log(se3.between(self.pose, other.pose))
        return float(error @ np.linalg.solve(self.covariance + other.covariance, error))

    def fused(self, other: UncertainPose) -> UncertainPose:
        """Return the covariance intersection with another pose of the same scan, of the least determinant."""
        own, added = np.linalg.inv(self.covariance), np.linalg.inv(other.covariance)
        share = max(_SHARES, key=lambda w: np.linalg.slogdet(w * own + (1 - w) * added)[1])
        covariance = np.linalg.inv(share * own + (1 - share) * added)
        error = se3.log(se3.between(self.pose, other.pose))
        step = (1 - share) * (covariance @ (added @ error))
        return UncertainPose(se3.orthonormalise(self.pose @ se3.exp(step)), (covariance + covariance.T) / 2)
