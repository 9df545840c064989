"""Relative poses to several recent scans beside the last one, from any source that can compare two scans.

A relative pose over a few metres is hardly less certain than one over a single step, and its error does not add up
over the steps between. The path then drifts less. :class:`hybridlio.core.estimates.EarlierScanPose` says how the
errors of one scan's relative poses depend on each other.
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
from hybridlio.sources.gate.gate_result import GATE_NIS
from hybridlio.sources.gate.innovation_gate import normalised_innovation_squared
from hybridlio.sources.settings import RecentScansSettings

_FLOOR = np.diag(PREDICTION_FLOOR_SIGMAS**2)  # of a scan relative to itself: exact, but to be positive definite


class PairSource(ResidualSource, Protocol):
    """A residual source that can compare any two scans that it was given."""

    @property
    def current_scan(self) -> Any:
        """The last scan given to ``start`` or ``refine``, in the form in which this source compares scans."""
        ...

    def pair(self, earlier: Any, current: Any, initial: RelativePose) -> RelativePose:
        """Return ``T_j_k`` of the current scan in an earlier one; ``initial`` with ``ok`` False where that fails.

        Args:
            earlier, current: values of :attr:`current_scan`.
            initial: about where the current scan is relative to the earlier one.
        """
        ...


@dataclass(frozen=True, eq=False)
class _RecentScan:
    """An earlier scan, and the path from it to the current one by consecutive steps.

    Attributes:
        stamp_ns: its stamp.
        scan: a value of :attr:`PairSource.current_scan`.
        pose: ``(4, 4)`` pose of the current scan in this one.
        covariance: ``(6, 6)`` of that pose; the sum over the steps.
    """

    stamp_ns: int
    scan: Any
    pose: Array = field(default_factory=lambda: np.eye(4))
    covariance: Array = field(default_factory=lambda: _FLOOR)

    def after(self, step: RelativePose) -> _RecentScan:
        """Return the same scan with the path one step longer."""
        covariance = se3.compose_covariance(self.covariance, step.pose, step.covariance)
        return replace(self, pose=self.pose @ step.pose, covariance=covariance)


class WithRecentScans:
    """Adds relative poses to recent scans to the steps of a source.

    The last scan that did not fail is compared too, whether or not it is one of the recent scans: after a bridged scan
    that undoes the bridge's error.

    Args:
        source: makes the steps and compares scans.
        settings: which scans are compared.
    """

    def __init__(self, source: PairSource, settings: RecentScansSettings) -> None:
        self.name = source.name
        self._source, self._settings = source, settings
        self._recent: list[_RecentScan] = []
        self._last_good: _RecentScan | None = None
        self._before: tuple[list[_RecentScan], _RecentScan | None] = ([], None)  # both, before the last step
        self._stamp_ns = 0

    def start(self, frame: Frame) -> None:
        """Take the first scan, which is also the first recent scan.

        Raises:
            DataError: the source cannot start at it.
        """
        self._source.start(frame)
        self._stamp_ns = frame.scan.stamp_ns
        self._last_good = _RecentScan(self._stamp_ns, self._source.current_scan)
        self._recent = [self._last_good]

    def refine(self, frame: Frame, initial: RelativePose) -> RelativePose:
        """Return the source's step, with the relative poses to recent scans that agree with the path."""
        step = self._source.refine(frame, initial)
        self._before = self._recent, self._last_good
        self._advance(step)
        compared = {k.stamp_ns: k for k in (*self._recent, self._last_good) if k is not None}
        found = [self._compare(k) for stamp, k in compared.items() if stamp != self._stamp_ns]
        self._stamp_ns = frame.scan.stamp_ns
        if step.ok:
            self._last_good = _RecentScan(self._stamp_ns, self._source.current_scan)
            if not self._recent or self._is_far(self._recent[-1].pose):
                self._recent = [*self._recent, self._last_good][-self._settings.count :]
        return self._with_shared_noise(step, [pose for pose in found if pose is not None])

    def take_back(self, initial: RelativePose) -> None:
        """Discard the last scan: the path continues by ``initial``."""
        self._recent, self._last_good = self._before
        self._advance(initial)
        if isinstance(self._source, TakesBack):
            self._source.take_back(initial)

    def _advance(self, step: RelativePose) -> None:
        self._recent = [scan.after(step) for scan in self._recent]
        self._last_good = None if self._last_good is None else self._last_good.after(step)

    def _compare(self, recent: _RecentScan) -> EarlierScanPose | None:
        """Return the current scan's pose in a recent one; None if that fails or contradicts the path between them."""
        path = RelativePose(recent.pose, recent.covariance, self.name)
        found = self._source.pair(recent.scan, self._source.current_scan, path)
        if not found.ok or normalised_innovation_squared(found, path) > GATE_NIS:
            return None
        return EarlierScanPose(recent.stamp_ns, found.pose, found.covariance)

    def _is_far(self, pose: Array) -> bool:
        angle_deg = np.degrees(np.linalg.norm(se3.so3_log(pose[:3, :3])))
        return bool(np.linalg.norm(pose[:3, 3]) > self._settings.distance_m or angle_deg > self._settings.angle_deg)

    def _with_shared_noise(self, step: RelativePose, found: list[EarlierScanPose]) -> RelativePose:
        """Split the covariances into the noise that a scan's relative poses share and the rest, each pose's own."""
        if not step.ok or step.drift is not None:
            return replace(step, earlier_scans=tuple(found))
        own = 1 - self._settings.shared
        earlier = tuple(replace(pose, covariance=own * pose.covariance) for pose in found)
        return replace(step, drift=own * step.covariance, earlier_scans=earlier)
