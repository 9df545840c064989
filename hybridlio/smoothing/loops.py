"""Loop closures as plain data: those that a search finds, and those that the smoothed graph keeps."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from hybridlio.core.arrays import Array
from hybridlio.core.covariance import check_covariance
from hybridlio.core.errors import DataError
from hybridlio.core.estimates import RelativePose
from hybridlio.core.se3 import check_pose

LISTED = 200  # rejected candidates in metrics.json, so that a run of thousands of loops keeps a readable file


@dataclass(frozen=True, eq=False)
class Loop:
    """Two scans of one place, far apart along the path.

    Attributes:
        earlier, later: rows of the run.
        pose: ``(4, 4)`` ``T_earlier_later``, lidar frames.
        covariance: ``(6, 6)`` of a right perturbation, rad² and m², rotation first.
        matched: share of points with a surface nearby.
        cost: mean robust cost of the registration, 0 to 1.
    """

    earlier: int
    later: int
    pose: Array
    covariance: Array
    matched: float
    cost: float

    def as_relative_pose(self) -> RelativePose:
        """Return the relative pose of the two scans."""
        return RelativePose(self.pose, self.covariance, "loop")


@dataclass(frozen=True)
class RejectedLoop:
    """A candidate that was rejected.

    Attributes:
        earlier, later: rows of the run.
        stage: ``verification``, ``consistency`` or ``solve``.
        reason: why, for the user.
    """

    earlier: int
    later: int
    stage: str
    reason: str


@dataclass(frozen=True, eq=False)
class LoopSearch:
    """The result of searching a run for loops.

    Attributes:
        keyframes, candidates, verified: number of each.
        loops: the consistent ones.
        rejected: the other candidates.
        seconds: time spent, by stage.
    """

    keyframes: int
    candidates: int
    verified: int
    loops: tuple[Loop, ...]
    rejected: tuple[RejectedLoop, ...]
    seconds: dict[str, float]


def given_loops(loops: Sequence[tuple[int, int, ArrayLike, ArrayLike]], scans: int) -> LoopSearch:
    """Return loops ``(i, j, T_i_j, covariance)`` that another program found, as if a search had found them.

    Args:
        loops: rows of two scans, the lidar pose of j in the frame of i ``(4, 4)``, and its covariance ``(6, 6)``.
        scans: number of scans in the run.

    Raises:
        DataError: a row that the run does not have, a pose that is not rigid, or a covariance that is not positive
            definite; names the loop.
    """
    found = []
    for i, j, T, covariance in loops:
        name = f"loop {i}-{j}"
        if i == j or not (0 <= i < scans and 0 <= j < scans):
            raise DataError(f"{name}: a loop joins two different scans of 0 to {scans - 1}")
        pose, spread = check_pose(np.asarray(T), name), check_covariance(np.asarray(covariance), name)
        found.append(Loop(i, j, pose, spread, matched=1.0, cost=0.0))
    return LoopSearch(scans, len(found), len(found), tuple(found), (), {})


@dataclass(frozen=True, eq=False)
class ClosedLoops:
    """The loops of a smoothed run.

    Attributes:
        search: the search that found the candidates.
        kept: loops that count in the solved graph.
        chi2: ``(L,)`` of each of ``search.loops`` in the solved graph; 6 on average for correct loops.
        rejected: all other candidates, with stage and reason.
    """

    search: LoopSearch
    kept: tuple[Loop, ...]
    chi2: Array
    rejected: tuple[RejectedLoop, ...]

    def summary(self) -> str:
        """Return the counts by stage, on one line."""
        search = self.search
        return (
            f"{search.candidates} candidates, {search.verified} verified, {len(search.loops)} consistent, "
            f"{len(self.kept)} kept"
        )

    def to_json_dict(self, first: int = 0) -> dict[str, Any]:
        """Return counts, the kept loops as pairs of scans, and up to :data:`LISTED` rejected candidates with reasons.

        ``first`` is the scan at which the run starts.
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
