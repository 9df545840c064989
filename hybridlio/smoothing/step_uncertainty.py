"""How sure odometry is of the relative pose of any two scans, from its steps alone.

Steps' errors are taken as independent, so that their covariances, each carried to the first scan's frame, add up; the
sum up to one scan less that up to another is the uncertainty between them, whatever lies in between.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array, Index
from hybridlio.core.estimates import RelativePose
from hybridlio.core.trajectory import Trajectory


class OdometryChain:
    """Relative poses and covariances between the ``N`` scans of a run.

    Where the online estimate is less sure than the steps alone would have it (an IMU's errors last for many steps), the
    covariances are larger by that much.
    """

    def __init__(self, online: Trajectory, steps: Sequence[RelativePose]) -> None:
        self.poses = online.poses
        lengths_m = np.linalg.norm(np.diff(self.poses[:, :3, 3], axis=0), axis=1)
        self.travelled_m: Array = np.append(0.0, np.cumsum(lengths_m))
        along = np.array([_along(step) for step in steps]).reshape(-1, 6, 6)
        beside = np.array([_beside(step) for step in steps]).reshape(-1, 6, 6)
        self._sums = np.concatenate(
            [np.zeros((1, 6, 6)), np.cumsum(se3.rotate_covariance(along, self.poses[1:]), axis=0)]
        )
        self._scatter = np.concatenate([np.zeros((1, 6, 6)), se3.rotate_covariance(beside, self.poses[1:])])
        self._scale: Array = np.ones(len(self.poses))
        if online.covariances is not None:
            own = self.covariance(np.zeros(len(self.poses), np.int64), np.arange(len(self.poses)))
            shares = _spread(online.covariances) / np.maximum(_spread(own), 1e-12)
            self._scale = np.maximum(1.0, np.where(self.travelled_m > 1.0, shares, 1.0))

    def relative(self, i: Index, j: Index) -> Array:
        """``T_i_j`` ``(…, 4, 4)`` of rows ``i`` and ``j``."""
        return se3.between(self.poses[i], self.poses[j])

    def covariance(self, i: Index, j: Index) -> Array:
        """Covariance ``(…, 6, 6)`` of :meth:`relative`, of right perturbations, rad² and m², rotation first."""
        later, earlier = np.maximum(i, j), np.minimum(i, j)
        world = self._sums[later] - self._sums[earlier] + self._scatter[i] + self._scatter[j]
        world = world * np.maximum(self._scale[i], self._scale[j])[..., None, None]
        return se3.rotate_covariance(world, se3.inverse(self.poses[j]))


def _along(step: RelativePose) -> Array:
    """What of a step's covariance adds up."""
    return step.covariance if step.drift is None or not step.ok else step.drift


def _beside(step: RelativePose) -> Array:
    """What of it is a scan's own scatter about a map; in the step from scan to scan it counts for both."""
    return np.zeros((6, 6)) if step.drift is None or not step.ok else (step.covariance - step.drift) / 2


def _spread(covariances: Array) -> Array:
    return np.asarray(np.trace(covariances[:, 3:, 3:], axis1=1, axis2=2))
