"""Residuals against several recent keyframes beside the last scan, for any source that can compare two scans.

A relative pose over a few metres hardly errs more than one over a single step, and does not add up: the path then
drifts less. What the poses of one scan share is said in :class:`hybridlio.core.estimates.EarlierScanPose`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.estimates import EarlierScanPose, RelativePose, ResidualSource, TakesBack
from hybridlio.core.motion_limits import PREDICTION_FLOOR_SIGMAS
from hybridlio.core.sensors import Frame
from hybridlio.core.setting_checks import check_not_negative, check_positive, check_setting
from hybridlio.sources.innovation_gate import GATE_NIS, normalised_innovation_squared

_FLOOR = np.diag(PREDICTION_FLOOR_SIGMAS**2)  # no way is known better


@dataclass(frozen=True)
class RecentScansSettings:
    """How many earlier scans, keyframes, each scan is compared with.

    Attributes:
        count: so many of the newest; 0 for none but the last scan.
        distance_m, angle_deg: a scan this far from the last keyframe becomes one.
        shared: how much of a relative pose's covariance is noise of its two scans, half each, that their other
            relative poses have too.

    Raises:
        SettingError: a value is out of range.
    """

    __pydantic_config__ = {"extra": "forbid"}  # noqa: RUF012  (read from YAML: unknown keys are errors)

    count: int = 0
    distance_m: float = 3.0
    angle_deg: float = 15.0
    shared: float = 0.75

    def __post_init__(self) -> None:
        check_not_negative(self, "count")
        check_positive(self, "distance_m", "angle_deg")
        check_setting(self, "shared", 0 <= self.shared < 1, "from 0 to below 1")


class PairSource(ResidualSource, Protocol):
    """A residual source that can compare any two scans that it has seen."""

    @property
    def seen(self) -> Any:
        """The scan last looked at, ready to be compared."""
        ...

    def pair(self, earlier: Any, current: Any, initial: RelativePose) -> RelativePose:
        """``T_j_k`` from an earlier scan to the current one; ``initial``, not ok, where that fails."""
        ...


@dataclass(frozen=True, eq=False)
class _Kept:
    """A scan that was kept, and the way from it to the current one by consecutive steps.

    Attributes:
        stamp_ns: its stamp.
        seen: as the source compares it.
        pose: ``(4, 4)`` of the current scan in this one.
        unsure: ``(6, 6)`` that has added up on the way.
    """

    stamp_ns: int
    seen: Any
    pose: Array = field(default_factory=lambda: np.eye(4))
    unsure: Array = field(default_factory=lambda: _FLOOR)

    def after(self, step: RelativePose) -> _Kept:
        """Seen from one step farther."""
        unsure = se3.compose_covariance(self.unsure, step.pose, step.covariance)
        return replace(self, pose=self.pose @ step.pose, unsure=unsure)


class WithRecentScans:
    """A source's steps, each with poses relative to the last keyframes.

    After a scan that failed, the last one that did not is among them, so that what the bridge was off by is taken back.

    Args:
        source: makes the steps, and compares.
        settings: how many, and how they are weighed.
    """

    def __init__(self, source: PairSource, settings: RecentScansSettings) -> None:
        self.name = source.name
        self._source, self._settings = source, settings
        self._keyframes: list[_Kept] = []
        self._good: _Kept | None = None  # the last scan that did not fail
        self._before: tuple[list[_Kept], _Kept | None] = ([], None)
        self._stamp_ns = 0

    def start(self, frame: Frame) -> None:
        """Take the first scan, the first keyframe.

        Raises:
            DataError: the source cannot start at it.
        """
        self._source.start(frame)
        self._stamp_ns = frame.scan.stamp_ns
        self._good = _Kept(self._stamp_ns, self._source.seen)
        self._keyframes = [self._good]

    def refine(self, frame: Frame, initial: RelativePose) -> RelativePose:
        """The source's step, with the poses relative to keyframes that agree with it."""
        step = self._source.refine(frame, initial)
        self._before = self._keyframes, self._good
        self._go_on(step)
        kept = {k.stamp_ns: k for k in (*self._keyframes, self._good) if k is not None}
        found = [self._compared(k) for stamp, k in kept.items() if stamp != self._stamp_ns]
        self._stamp_ns = frame.scan.stamp_ns
        if step.ok:
            self._good = _Kept(self._stamp_ns, self._source.seen)
            if not self._keyframes or self._is_far(self._keyframes[-1].pose):
                self._keyframes = [*self._keyframes, self._good][-self._settings.count :]
        return self._shared(step, [keyframe for keyframe in found if keyframe is not None])

    def take_back(self, initial: RelativePose) -> None:
        """Leave the last scan out: the path goes on by ``initial``."""
        self._keyframes, self._good = self._before
        self._go_on(initial)
        if isinstance(self._source, TakesBack):
            self._source.take_back(initial)

    def _go_on(self, step: RelativePose) -> None:
        self._keyframes = [kept.after(step) for kept in self._keyframes]
        self._good = None if self._good is None else self._good.after(step)

    def _compared(self, kept: _Kept) -> EarlierScanPose | None:
        """The scan relative to a keyframe; None where that fails or is not where the path could have come to."""
        guess = RelativePose(kept.pose, kept.unsure, self.name)
        found = self._source.pair(kept.seen, self._source.seen, guess)
        if not found.ok or normalised_innovation_squared(found, guess) > GATE_NIS:
            return None
        return EarlierScanPose(kept.stamp_ns, found.pose, found.covariance)

    def _is_far(self, way: Array) -> bool:
        angle_deg = np.degrees(np.linalg.norm(se3.so3_log(way[:3, :3])))
        return bool(np.linalg.norm(way[:3, 3]) > self._settings.distance_m or angle_deg > self._settings.angle_deg)

    def _shared(self, step: RelativePose, keyframes: list[EarlierScanPose]) -> RelativePose:
        """With what the step's covariance shares with the keyframes' told from what is each pose's own."""
        if not step.ok or step.drift is not None:
            return replace(step, earlier_scans=tuple(keyframes))
        own = 1 - self._settings.shared
        near = tuple(replace(keyframe, covariance=own * keyframe.covariance) for keyframe in keyframes)
        return replace(step, drift=own * step.covariance, earlier_scans=near)
