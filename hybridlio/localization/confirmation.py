"""When a place is believed: several scans, metres apart, must name the same pose of the run in the map."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.setting_checks import check_fraction, check_not_negative, check_positive


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
        T_map_world: ``(4, 4)`` pose of the odometry's world in the map.
        T_world_lidar: ``(4, 4)`` of the scan.
        travelled_m: along the path.
        covariance: ``(6, 6)`` of ``T_map_world · T_world_lidar``.
    """

    T_map_world: Array
    T_world_lidar: Array
    travelled_m: float
    covariance: Array

    @property
    def T_map_lidar(self) -> Array:
        """``(4, 4)`` pose of the scan in the map."""
        return np.asarray(self.T_map_world @ self.T_world_lidar)


@dataclass(eq=False)
class Confirmation:
    """Collects votes until enough of them agree."""

    settings: ConfirmationSettings = field(default_factory=ConfirmationSettings)
    _votes: list[Vote] = field(default_factory=list)

    def add(self, vote: Vote) -> bool:
        """Add a vote; return whether it is confirmed by others, and no other answer is nearly as good."""
        settings = self.settings
        self._votes = [v for v in self._votes if vote.travelled_m - v.travelled_m < settings.window_m] + [vote]
        agreeing = [one for one in self._votes if self._agree(vote, one)]
        places = {one.travelled_m for one in agreeing}
        others = {one.travelled_m for one in self._votes if one not in agreeing} - places
        span_m = vote.travelled_m - min(places)
        enough = len(places) >= settings.places and span_m >= settings.distance_m
        return enough and len(others) <= settings.rival_share * len(places)

    def clear(self) -> None:
        """Forget all votes."""
        self._votes = []

    def _agree(self, one: Vote, other: Vote) -> bool:
        """Return whether two votes place the later scan alike."""
        gap = se3.log(se3.between(one.T_map_lidar, other.T_map_world @ one.T_world_lidar))
        apart_m, apart_deg = np.linalg.norm(gap[3:]), np.rad2deg(np.linalg.norm(gap[:3]))
        return bool(apart_m <= self.settings.max_difference_m and apart_deg <= self.settings.max_difference_deg)
