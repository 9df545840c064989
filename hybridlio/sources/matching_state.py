"""The state of scan matching: its own path through the map, and pending changes of the map."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.estimates import RelativePose
from hybridlio.registration.results import ObservedRegistration

# Scans in a row that seem to observe what others before did not, and are not believed. In tunnels one sparse scan in
# ten or twenty seems to; over 24 recordings of 12 s with 20,000 points a scan, up to three in a row did.
_DISBELIEVED_CLAIMS = 4


@dataclass(frozen=True, eq=False)
class PathPoint:
    """One scan on scan matching's path.

    Attributes:
        T_map_lidar: ``(4, 4)`` pose of the scan.
        twist: ``(6,)`` per second, of the step to this scan; None where it is not known.
        bridged: whether the pose is a prediction, because the scan could not be matched.
        bridge_covariance: ``(6, 6)`` that the predictions since the last matched scan have added up to.
        map_changed: whether the map gets a keyframe between the last matched scan and the next one.
        weak_covariance: ``(6, 6)`` of the pose relative to the map along directions that scans constrain weakly.
    """

    T_map_lidar: Array
    twist: Array | None = None
    bridged: bool = False
    bridge_covariance: Array = field(default_factory=lambda: np.zeros((6, 6)))
    map_changed: bool = False
    weak_covariance: Array = field(default_factory=lambda: np.zeros((6, 6)))

    def predicted_covariance(self, initial: RelativePose) -> Array:
        """Return the covariance ``(6, 6)`` relative to the map of the next scan placed by its initial pose."""
        return se3.compose_covariance(self.bridge_covariance + self.weak_covariance, initial.pose, initial.covariance)

    @property
    def sigma_m(self) -> float:
        """Standard deviation of the position as the bridges have left it, all axes together."""
        return float(np.sqrt(self.bridge_covariance[3:, 3:].trace()))

    def bridged_by(self, initial: RelativePose) -> PathPoint:
        """Return the next scan's point if that scan is placed by its initial pose.

        The errors of predictions in a row come from one error of the velocity, and the graph may know them from the
        samples as well. The covariance therefore holds for any correlation between them.
        """
        covariance = _sum_of_correlated(self.bridge_covariance, initial)
        return PathPoint(
            self.T_map_lidar @ initial.pose, None, True, covariance, self.map_changed, self.weak_covariance
        )

    def added_since(self, before: PathPoint, initial: RelativePose) -> Array:
        """Return the covariance ``(6, 6)`` that the step from the point before has added to the bridges' errors.

        A chain of independent steps with these covariances has the same sum. Without an IMU the error of one velocity
        is in all of them.
        """
        moved = se3.compose_covariance(before.bridge_covariance, initial.pose, np.zeros((6, 6)))
        return self.bridge_covariance - moved


def _sum_of_correlated(before: Array, step: RelativePose) -> Array:
    """Return a covariance ``(6, 6)`` of a pose after a step that no correlation of the two exceeds.

    For any t > 0, ``Cov(a + b) ≤ (1 + 1/t) Cov(a) + (1 + t) Cov(b)``; this t keeps the positions' trace smallest.
    """
    if not before.any():
        return step.covariance
    moved = se3.compose_covariance(before, step.pose, np.zeros((6, 6)))
    t = float(np.sqrt(moved[3:, 3:].trace() / step.covariance[3:, 3:].trace()))
    return np.asarray((1 + 1 / t) * moved + (1 + t) * step.covariance)


@dataclass(frozen=True, eq=False)
class MatchingState:
    """Scan matching's state after a scan. Transitions return a new state.

    Attributes:
        current: the last scan.
        previous: the scan before it, to which :meth:`taken_back` returns.
        doubted: the last scan as it was matched, if that was taken back because the IMU contradicts it; None otherwise.
            If the IMU is wrong, the next scan is still found from here.
        keyframe: ``(N, 3)`` points of the last scan, lidar frame, that go into the map before the next scan is matched;
            None where the scan is no keyframe. They wait because the scan may be taken back.
        unmatched: number of scans in a row that had enough points and did not fit the map.
        adrift: number of scans in a row, up to the last, whose position relative to the map is unknown. Unless it is 0,
            the next keyframe starts a new map.
        unobserved: ``(U, 6)`` unit tangent directions that the last scan of these left unobserved.
        claims: number of scans in a row, up to the last, that seemed to observe all directions and were not believed.
    """

    current: PathPoint
    previous: PathPoint
    doubted: PathPoint | None = None
    keyframe: Array | None = None
    adrift: int = 0
    unobserved: Array = field(default_factory=lambda: np.empty((0, 6)))
    claims: int = 0
    unmatched: int = 0

    @classmethod
    def started(cls, keyframe: Array) -> MatchingState:
        """Return the state after the first scan, which is the map's origin and its first keyframe."""
        origin = PathPoint(np.eye(4), map_changed=True)
        return cls(origin, origin, keyframe=keyframe)

    @classmethod
    def placed(cls, T_map_previous: Array, T_map_lidar: Array, dt_s: float, keyframe: Array) -> MatchingState:
        """Return the state after scans whose poses were found otherwise.

        Args:
            T_map_previous, T_map_lidar: ``(4, 4)`` poses of the last two.
            dt_s: time between them.
            keyframe: ``(N, 3)`` points of all scans in the frame of the last.
        """
        twist = se3.log(se3.between(T_map_previous, T_map_lidar)) / dt_s
        return cls(PathPoint(T_map_lidar, twist, map_changed=True), PathPoint(T_map_previous), keyframe=keyframe)

    def matched(
        self, T_map_lidar: Array, dt_s: float, unobserved: Array, adrift: int, weak_covariance: Array | None = None
    ) -> MatchingState:
        """Return the state after a scan that was matched.

        Args:
            T_map_lidar: ``(4, 4)`` the pose found.
            dt_s: time since the last scan.
            unobserved: ``(U, 6)`` unit tangent directions that the scan leaves unconstrained.
            adrift: number of scans in a row, with this one, whose position relative to the map is unknown.
            weak_covariance: ``(6, 6)`` of the pose along weak directions; None if there are none.
        """
        weak = np.zeros((6, 6)) if weak_covariance is None else weak_covariance
        last = self.doubted or (None if self.current.bridged else self.current)
        twist = None
        if last is not None and not len(unobserved):
            twist = se3.log(se3.between(last.T_map_lidar, T_map_lidar)) / dt_s
        found = PathPoint(T_map_lidar, twist, weak_covariance=weak)
        if not adrift:
            return MatchingState(found, self.current)
        if len(unobserved):
            return MatchingState(found, self.current, adrift=adrift, unobserved=unobserved)
        return MatchingState(found, self.current, adrift=adrift, unobserved=self.unobserved, claims=self.claims + 1)

    def believed(
        self, observed: ObservedRegistration, is_vague: bool, is_dense: bool
    ) -> tuple[ObservedRegistration, int]:
        """Return what is believed of the next scan's registration, and how many scans in a row are adrift with it.

        Args:
            observed: the registration.
            is_vague: whether its initial pose is too uncertain to fill in for a direction that it leaves unconstrained.
            is_dense: whether what a single scan observes is no chance, as of a lidar that repeats its pattern.
        """
        unobserved = observed.degenerate
        if not self.is_adrift_with(unobserved, is_vague):
            return observed, 0
        times = self.adrift + (len(unobserved) > 0)
        observed = observed.adrift(times, unobserved[:0] if is_dense else self.unobserved)
        return observed, self.adrift + 1 if len(observed.degenerate) else 0

    def is_adrift_with(self, unobserved: Array, is_vague: bool) -> bool:
        """Return whether the next scan's position is unknown, or was until this scan, which may have it by chance.

        Args:
            unobserved: ``(U, 6)`` unit tangent directions that it leaves unconstrained.
            is_vague: whether its initial pose is too uncertain to fill in for such a direction.
        """
        return is_vague and (len(unobserved) > 0 or (len(self.unobserved) > 0 and self.claims < _DISBELIEVED_CLAIMS))

    def bridged(self, initial: RelativePose, first_keyframe: Array | None = None) -> MatchingState:
        """Return the state after a scan that could not be matched, placed by its initial pose.

        Args:
            initial: initial relative pose of the step to it.
            first_keyframe: the scan's points where the map is still empty; None otherwise.
        """
        bridge = self.current.bridged_by(initial)
        return replace(self, current=bridge, previous=self.current, doubted=None, keyframe=first_keyframe)

    def taken_back(self, initial: RelativePose) -> MatchingState:
        """Return the state after the last scan's match was rejected: placed by its initial pose, and no keyframe."""
        return replace(self, current=self.previous.bridged_by(initial), doubted=self.current, keyframe=None)

    def keyframe_pending(self, keyframe: Array) -> MatchingState:
        """Return the state in which the last scan, with these points, goes into the map before the next one."""
        return replace(self, current=replace(self.current, map_changed=True), keyframe=keyframe)

    def keyframe_inserted(self) -> MatchingState:
        """Return the state after the pending keyframe has gone into the map."""
        return replace(self, keyframe=None)

    def restarted(self, keyframe: Array) -> MatchingState:
        """Return the state in which a new map starts at the last scan, because scans no longer fit the old one."""
        here = replace(self.current, bridge_covariance=np.zeros((6, 6)), map_changed=True)
        return replace(self, current=here, keyframe=keyframe, adrift=1, unmatched=0)

    @property
    def last_found(self) -> PathPoint:
        """The last scan where it was matched, even if that was taken back."""
        return self.doubted or self.current
