"""Loop closures in smoothing: each one a between-factor of two scans far apart, which a robust solve may reject."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
from gtsam.symbol_shorthand import X

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.estimates import State
from hybridlio.graph.run.factor_groups import Doubtful, GroupAnswer, GroupFactors
from hybridlio.record.record import Record
from hybridlio.smoothing.loop_closure import Loop, LoopSearch, LoopSettings, RejectedLoop, find_loops

_KEPT_WEIGHT = 0.5
LISTED = 200  # rejected candidates in metrics


@dataclass(frozen=True, eq=False)
class ClosedLoops:
    """What became of a run's loops.

    Attributes:
        search: how they were found.
        kept: the loops that the solve holds to.
        chi2: ``(L,)`` of each of ``search.loops``, in the solved graph; 6 on average.
        rejected: all candidates that are none of them, with stage and reason.
    """

    search: LoopSearch
    kept: tuple[Loop, ...]
    chi2: Array
    rejected: tuple[RejectedLoop, ...]

    def summary(self) -> str:
        """One line that says what became of the candidates."""
        search = self.search
        return (
            f"{search.candidates} candidates, {search.verified} verified, {len(search.loops)} consistent, "
            f"{len(self.kept)} kept"
        )

    def to_json_dict(self, first: int = 0) -> dict[str, Any]:
        """Counts, the loops kept as pairs of scans, and the first rejected candidates with their reasons.

        ``first`` is the scan that the run starts at.
        """
        rejected = self.rejected[:LISTED]
        return {
            "keyframes": self.search.keyframes,
            "candidates": self.search.candidates,
            "verified": self.search.verified,
            "consistent": len(self.search.loops),
            "kept": len(self.kept),
            "rejected_by_stage": dict(Counter(one.stage for one in self.rejected)),
            "seconds": self.search.seconds,
            "scans": [[first + loop.earlier, first + loop.later] for loop in self.kept],
            "rejected": [vars(one) | {"earlier": first + one.earlier, "later": first + one.later} for one in rejected],
        }


class LoopClosures:
    """The loops of a run, as a group of factors.

    Args:
        search: what was found in the run.
        T_imu_lidar: the extrinsics.
    """

    name = "loops"
    robust: str | None = "gnc"

    def __init__(self, search: LoopSearch, T_imu_lidar: Array) -> None:
        self._search, self._T_imu_lidar = search, T_imu_lidar

    @classmethod
    def of(
        cls, record: Record, settings: LoopSettings | None, progress: Callable[[str, int, int], None] | None
    ) -> LoopClosures:
        """Find a record's loops; arguments and errors as :func:`hybridlio.smoothing.loop_closure.find_loops`."""
        return cls(find_loops(record, settings, progress), record.calibration.T_imu_lidar)

    def build(self, states: Sequence[State], before: gtsam.Values | None) -> GroupFactors:
        """One between-factor for each loop."""
        del states, before
        return GroupFactors(doubtful=[self._factor(loop) for loop in self._search.loops])

    def read(self, answer: GroupAnswer) -> ClosedLoops:
        """Which loops were kept."""
        loops = self._search.loops
        right = [weight >= _KEPT_WEIGHT for weight in answer.weights]
        wrong = tuple(
            RejectedLoop(loop.earlier, loop.later, "solve", f"the other factors disagree (χ² {chi2:.0f})")
            for loop, is_right, chi2 in zip(loops, right, answer.chi2, strict=True)
            if not is_right
        )
        kept = tuple(loop for loop, is_right in zip(loops, right, strict=True) if is_right)
        return ClosedLoops(self._search, kept, answer.chi2, (*self._search.rejected, *wrong))

    def _factor(self, loop: Loop) -> Doubtful:
        pose = gtsam.Pose3(self._T_imu_lidar @ loop.pose @ se3.inverse(self._T_imu_lidar))
        covariance = se3.rotate_covariance(loop.covariance, self._T_imu_lidar)

        def make(model: gtsam.noiseModel.Base) -> gtsam.NonlinearFactor:
            return gtsam.BetweenFactorPose3(X(loop.earlier), X(loop.later), pose, model)

        return Doubtful(make, covariance, f"loop {loop.earlier}-{loop.later}")
