"""Uncertainty of odometry's relative pose between any two scans of a run, from its steps alone.

Errors of different steps are taken as independent, so their covariances, each rotated into the first scan's frame, add
up. The sum up to one scan less the sum up to another is the uncertainty between the two.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Index
from hybridlio.core.estimates import RelativePose
from hybridlio.core.trajectory import Trajectory

_MIN_TRAVELLED_M = 1.0  # below, both covariances are nearly 0 and their ratio is meaningless


class OdometryChain:
    """Relative poses and covariances between the ``N`` scans of a run.

    Where the online estimate is less certain than its steps alone imply (errors of an IMU persist over many steps), the
    covariances are scaled up to it.

    Args:
        online: the run's online estimate.
        steps: ``N-1`` relative poses of consecutive scans.

    Attributes:
        poses: ``(N, 4, 4)`` of the online estimate.
        travelled_m: ``(N,)`` distance travelled from the first scan.
    """

    def __init__(self, online: Trajectory, steps: Sequence[RelativePose]) -> None:
        self.poses = online.poses
        lengths_m = np.linalg.norm(np.diff(self.poses[:, :3, 3], axis=0), axis=1)
        self.travelled_m: Array = np.append(0.0, np.cumsum(lengths_m))
        drift = np.array([drift_of(step) for step in steps]).reshape(-1, 6, 6)
        scatter = np.array([_scatter(step) for step in steps]).reshape(-1, 6, 6)
        self._sums = np.concatenate(
            [np.zeros((1, 6, 6)), np.cumsum(se3.rotate_covariance(drift, self.poses[1:]), axis=0)]
        )
        self._scatter = np.concatenate([np.zeros((1, 6, 6)), se3.rotate_covariance(scatter, self.poses[1:])])
        self._scale: Array = np.ones(len(self.poses))
        if online.covariances is not None:
            own = self.covariance(np.zeros(len(self.poses), np.int64), np.arange(len(self.poses)))
            ratios = _position_variance(online.covariances) / np.maximum(_position_variance(own), 1e-12)
            self._scale = np.maximum(1.0, np.where(self.travelled_m > _MIN_TRAVELLED_M, ratios, 1.0))

    def relative(self, i: Index, j: Index) -> Array:
        """Return ``T_i_j`` ``(…, 4, 4)`` of rows ``i`` and ``j``."""
        return se3.between(self.poses[i], self.poses[j])

    def covariance(self, i: Index, j: Index) -> Array:
        """Return the covariance ``(…, 6, 6)`` of :meth:`relative`, right perturbations, rad² and m², rotation first."""
        later, earlier = np.maximum(i, j), np.minimum(i, j)
        world = self._sums[later] - self._sums[earlier] + self._scatter[i] + self._scatter[j]
        world = world * np.maximum(self._scale[i], self._scale[j])[..., None, None]
        return se3.rotate_covariance(world, se3.inverse(self.poses[j]))


def drift_of(step: RelativePose) -> Array:
    """Return the part ``(6, 6)`` of a step's covariance that adds up over steps."""
    return step.covariance if step.drift is None or not step.ok else step.drift


def _scatter(step: RelativePose) -> Array:
    """The scatter of one scan about the source's map; a step's covariance contains it twice, for both its scans."""
    return np.zeros((6, 6)) if step.drift is None or not step.ok else (step.covariance - step.drift) / 2


def _position_variance(covariances: Array) -> Array:
    return np.asarray(np.trace(covariances[:, 3:, 3:], axis1=1, axis2=2))
