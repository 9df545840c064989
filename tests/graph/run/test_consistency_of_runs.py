"""Consistency of covariances of whole runs, by `Odometry` and `smooth`; see also benchmarks/consistency.py."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.estimates import RelativePose, State
from hybridlio.core.motion_limits import unknown_motion_covariance
from hybridlio.core.sensors import Frame
from hybridlio.evaluation.consistency import pose_consistency
from hybridlio.graph.run.smooth import smooth
from hybridlio.odometry.odometry import Odometry


class Standstill:
    name = "standstill"

    def predict(self, frame: Frame, state: State) -> RelativePose:
        del frame, state
        return RelativePose(np.eye(4), unknown_motion_covariance(0.1), self.name)

    def correct(self, frame: Frame, estimate: RelativePose) -> None: ...


class Simulated:
    name = "simulated"

    def __init__(self, relative: list[RelativePose]) -> None:
        self._relative = relative

    def start(self, frame: Frame) -> None: ...

    def refine(self, frame: Frame, initial: RelativePose) -> RelativePose:
        del initial
        return self._relative[frame.index - 1]


@pytest.mark.parametrize("drift_share", [None, 0.02], ids=["steps", "map"])
def test_covariances_of_runs_are_consistent_online_and_smoothed(chain: Callable[..., Any], drift_share: float | None):
    errors: dict[str, list[np.ndarray]] = {"online": [], "smoothed": []}
    covariances: dict[str, list[np.ndarray]] = {"online": [], "smoothed": []}
    for seed in range(700, 708):
        drive = chain(seed, steps=40, drift_share=drift_share)
        odometry = Odometry(Standstill(), Simulated(drive.relative), "fixed-lag" if seed % 2 else "incremental")
        for frame in drive.frames:
            odometry.step(frame)
        record = odometry.record()
        for name, trajectory in (("online", record.online), ("smoothed", smooth(record).trajectory)):
            errors[name].append(se3.log(se3.between(trajectory.poses, drive.lidar_poses))[1:])
            covariances[name].append(trajectory.covariances[1:])
    for name in errors:
        found = pose_consistency(np.concatenate(errors[name]), np.concatenate(covariances[name]))
        # the mean over one drive has a standard deviation of 0.5: 0.18 for eight drives
        assert 0.6 < found.rotation.value < 1.45, name
        assert 0.6 < found.position.value < 1.45, name
