"""Loop closures in smoothing: each is a between-factor of two scans far apart, which the robust method may reject."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
from gtsam.symbol_shorthand import X

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.estimates import State
from hybridlio.graph.run.factor_groups import GroupFactors, GroupSolution, PossibleOutlier
from hybridlio.smoothing.loops import ClosedLoops, Loop, LoopSearch, RejectedLoop

_KEPT_WEIGHT = 0.5  # a loop of this weight counts as kept; GNC's weights are 0 or 1, kernels' in between


class LoopClosures:
    """The loops of a run, as a group of factors.

    Args:
        search: loops found in the run.
        T_imu_lidar: ``(4, 4)``.
    """

    name = "loops"
    robust: str | None = "gnc"

    def __init__(self, search: LoopSearch, T_imu_lidar: Array) -> None:
        self._search, self.T_imu_lidar = search, T_imu_lidar

    def build(self, states: Sequence[State], previous: gtsam.Values | None) -> GroupFactors:
        """Return one between-factor for each loop."""
        del states, previous
        return GroupFactors(possible_outliers=[self._factor(loop) for loop in self._search.loops])

    def read(self, solution: GroupSolution) -> ClosedLoops:
        """Return which loops were kept, and why the others were not."""
        loops = self._search.loops
        right = [weight >= _KEPT_WEIGHT for weight in solution.weights]
        wrong = tuple(
            RejectedLoop(loop.earlier, loop.later, "solve", f"the other factors disagree (χ² {chi2:.0f})")
            for loop, is_right, chi2 in zip(loops, right, solution.chi2, strict=True)
            if not is_right
        )
        kept = tuple(loop for loop, is_right in zip(loops, right, strict=True) if is_right)
        return ClosedLoops(self._search, kept, solution.chi2, (*self._search.rejected, *wrong))

    def _factor(self, loop: Loop) -> PossibleOutlier:
        pose = gtsam.Pose3(self.T_imu_lidar @ loop.pose @ se3.inverse(self.T_imu_lidar))
        covariance = se3.rotate_covariance(loop.covariance, self.T_imu_lidar)

        def make(model: gtsam.noiseModel.Base) -> gtsam.NonlinearFactor:
            return gtsam.BetweenFactorPose3(X(loop.earlier), X(loop.later), pose, model)

        return PossibleOutlier(make, covariance, f"loop {loop.earlier}-{loop.later}")
