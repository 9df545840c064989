"""The uncertainty of the poses that a start's motions give."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import block_diag

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.estimates import EarlierScanPose, RelativePose
from hybridlio.core.motion_limits import MEASUREMENT_FLOOR_SIGMAS
from hybridlio.registration.joint_motion import SIZE, JointMotion

_TEMPERATURE = 1.5  # of the weights of motions that are left, as in hybridlio/registration/cost_profile.py
MOST_SCANS = 10  # of a search: a second at 10 Hz
# On the variance of steps before the decision, as all of these scans may repeat one false motion. Their points count
# again in the decided poses. In 46 starts of a rosette, a tenth at most of what they claim counts: with all of it the
# squared normalised error of positions is 2.3 over the first 1.6 s, so it is 0.8, and with a hundredth the steps of
# slow starts are lost (0.035 instead of 0.031 m).
_UNDECIDED_SCALE = float(MOST_SCANS)
_FLOOR = np.diag(MEASUREMENT_FLOOR_SIGMAS**2)


@dataclass(frozen=True, eq=False)
class MotionSpread:
    """The uncertainty of relative poses: of the chosen motion, its distance from the others, and what it still moves.

    Attributes:
        stamps_ns, times_s: of the scans, and their times since the first ``(K,)``.
        motions: those that are left, the best first.
        poses: of each, the ``(K, 4, 4)`` poses of the scans.
        chosen: number of the motion whose poses are given.
        unsettled: ``(6,)`` by how much the last scan has moved the motion, per second since the first.
    """

    stamps_ns: list[int]
    times_s: Array
    motions: list[JointMotion]
    poses: list[Array]
    chosen: int
    unsettled: Array = field(default_factory=lambda: np.zeros(6))

    def step(self, source: str, is_decided: bool) -> RelativePose:
        """Return the step to the last scan; once decided, with its poses relative to all scans before."""
        poses, stamps_ns, last = self.poses[self.chosen], self.stamps_ns, len(self.stamps_ns) - 1
        step = se3.between(poses[last - 1], poses[last])
        if not is_decided:  # the errors of all these steps are one and the same, and do not cancel
            return RelativePose(step, _UNDECIDED_SCALE * self.covariance(0, last), source)
        # As many poses as scans before show one motion, and count as independent: together they weigh as it does.
        earlier = (
            EarlierScanPose(stamps_ns[j], se3.between(poses[j], poses[last]), last * self.covariance(j, last))
            for j in range(last - 1)
        )
        return RelativePose(step, last * self.covariance(last - 1, last), source, earlier_scans=tuple(earlier))

    def covariance(self, j: int, k: int) -> Array:
        """Return the covariance ``(6, 6)`` of scan ``k``'s pose in scan ``j``'s frame.

        Rotation and translation of one motion against another are taken as independent: between motions that lie metres
        apart there is nothing in between, and a rotation that the gyroscope corrects slightly must not move the lidar.
        """
        rises = np.array([motion.rise_over_scatter(self.motions[0]) for motion in self.motions])
        weights = np.exp(-rises / _TEMPERATURE)
        weights /= weights.sum()
        step = se3.between(self.poses[self.chosen][j], self.poses[self.chosen][k])
        time_s = self.times_s[k] - self.times_s[j]
        total = _FLOOR + self._of_motion(j, k) + _two_blocks(time_s * self.unsettled)
        for weight, poses in zip(weights, self.poses, strict=True):
            total = total + weight * _two_blocks(se3.log(se3.between(step, se3.between(poses[j], poses[k]))))
        return np.asarray(total)

    def _of_motion(self, j: int, k: int) -> Array:
        """Return the part by the chosen motion's own covariance."""
        t, R = self.times_s, self.poses[self.chosen][k][:3, :3]
        to_step = np.zeros((6, SIZE))
        to_step[:3, :3] = (t[k] - t[j]) * R.T
        to_step[3:, 3:6] = (t[k] - t[j]) * R.T
        to_step[3:, 6:] = (t[k] ** 2 - t[j] ** 2) / 2 * R.T
        return np.asarray(to_step @ self.motions[self.chosen].covariance @ to_step.T)


def _two_blocks(apart: Array) -> Array:
    """Return the covariance ``(6, 6)`` of a displacement ``(6,)`` with its rotation and translation independent."""
    return np.asarray(block_diag(*(np.outer(part, part) for part in (apart[:3], apart[3:]))))
