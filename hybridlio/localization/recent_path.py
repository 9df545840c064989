"""The last stretch of a run under way, as places."""

from __future__ import annotations

from collections import deque

import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.core.estimates import RelativePose
from hybridlio.core.sensors import Scan
from hybridlio.core.trajectory import Trajectory
from hybridlio.record.loop_keyframes import LoopKeyframes, LoopKeyframeSelector, LoopKeyframeSettings
from hybridlio.smoothing.places import KeyframePlaces
from hybridlio.smoothing.step_uncertainty import OdometryChain

_SCANS = 300  # half a minute at 10 Hz; surroundings reach 10 m along the path


class RecentPath:
    """Poses and keyframes of the last scans.

    Args:
        settings: which scans become keyframes.
        reach_m: keyframes this near along the path are merged.
    """

    def __init__(self, settings: LoopKeyframeSettings, reach_m: float) -> None:
        self._selector, self._reach_m = LoopKeyframeSelector(settings), reach_m
        self._stamps: deque[int] = deque(maxlen=_SCANS)
        self._poses: deque[Array] = deque(maxlen=_SCANS)
        self._steps: deque[RelativePose] = deque(maxlen=_SCANS)
        self._count = 0

    def add(self, scan: Scan, pose: Array, step: RelativePose) -> bool:
        """Add a scan with its pose ``T_world_lidar`` and the step to it; return whether it is a keyframe."""
        self._stamps.append(scan.stamp_ns)
        self._poses.append(pose)
        self._steps.append(step)
        self._count += 1
        if self._count % _SCANS == 0:  # older keyframes are of no use, and would grow with the run
            recent = self._selector.kept_since(self._count - _SCANS)
            self._selector.restore(recent, self._selector.last_position)
        return self._selector.offer(self._count - 1, scan, pose)

    def places(self, up: Array) -> KeyframePlaces:
        """Return the keyframes as places, the newest last.

        Args:
            up: ``(3,)`` in world.
        """
        first = self._count - len(self._poses)
        kept = self._selector.kept_since(first)
        rows = np.array([row - first for row, _, _ in kept], np.int64)
        stamps = np.array([stamp for _, stamp, _ in kept], np.int64)
        keyframes = LoopKeyframes(rows, stamps, tuple(cloud.cloud() for _, _, cloud in kept))
        poses = np.array(self._poses)
        chain = OdometryChain(Trajectory(np.array(self._stamps), poses), list(self._steps)[1:])
        return KeyframePlaces(keyframes, chain, up, self._reach_m)
