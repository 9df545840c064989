"""When a place is believed: several scans, metres apart, must name the same pose of the run in the map."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.setting_checks import check_fraction, check_not_negative, check_positive
from hybridlio.localization.fusion import UncertainPose


@dataclass(frozen=True)
class ConfirmationSettings:
    """When a candidate is believed.

    Attributes:
        places: number of scans that must agree.
        distance_m: path that they must span.
        window_m: path within which they must lie.
        max_difference_m, max_difference_deg: between two that agree: as between the two registrations of one loop, and
            as much again for the odometry between them.
        rival_share: a candidate is not believed while others have more than this share of its agreeing scans.

    Raises:
        SettingError: a value is out of range.
    """

    places: int = 3
    distance_m: float = 8.0
    window_m: float = 60.0
    max_difference_m: float = 0.6
    max_difference_deg: float = 1.0
    rival_share: float = 0.5

    def __post_init__(self) -> None:
        check_positive(self, "places", "window_m", "max_difference_m", "max_difference_deg")
        check_not_negative(self, "distance_m")
        check_fraction(self, "rival_share")


@dataclass(frozen=True, eq=False)
class Vote:
    """One scan's answer.

    Attributes:
        at: of the present scan in the map: the answer, carried on by odometry.
        travelled_m: of the scan that gave it, along the path.
    """

    at: UncertainPose
    travelled_m: float


@dataclass(eq=False)
class Confirmation:
    """Collects votes until enough of them agree."""

    settings: ConfirmationSettings = field(default_factory=ConfirmationSettings)
    _votes: list[Vote] = field(default_factory=list)

    def move(self, step: Array, covariance: Array) -> None:
        """Carry all votes on by a step ``T_k_k1`` ``(4, 4)`` of the odometry with its covariance."""
        self._votes = [replace(one, at=one.at.moved(step, covariance)) for one in self._votes]

    def add(self, vote: Vote) -> UncertainPose | None:
        """Add a vote of the present scan; return its pose once others confirm it and no other answer is nearly as good.

        The pose is that of the vote nearest to all that agree: a registration can settle in a minimum decimetres off,
        within what counts as agreement, and then claims to be sure.
        """
        settings = self.settings
        self._votes = [v for v in self._votes if vote.travelled_m - v.travelled_m < settings.window_m] + [vote]
        agreeing = [one for one in self._votes if self._difference(vote, one) <= 1.0]
        places = {one.travelled_m for one in agreeing}
        others = {one.travelled_m for one in self._votes if one not in agreeing} - places
        span_m = vote.travelled_m - min(places)
        if len(places) < settings.places or span_m < settings.distance_m:
            return None
        if len(others) > settings.rival_share * len(places):
            return None
        return min(agreeing[::-1], key=lambda one: sum(self._difference(one, other) for other in agreeing)).at

    def clear(self) -> None:
        """Forget all votes."""
        self._votes = []

    def _difference(self, one: Vote, other: Vote) -> float:
        """Return how far two votes are apart, as a share of what counts as agreement."""
        gap = se3.log(se3.between(one.at.pose, other.at.pose))
        apart_m, apart_deg = np.linalg.norm(gap[3:]), np.rad2deg(np.linalg.norm(gap[:3]))
        return float(max(apart_m / self.settings.max_difference_m, apart_deg / self.settings.max_difference_deg))
