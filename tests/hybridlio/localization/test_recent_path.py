"""The recent path holds what recognition needs, however long the run."""

from __future__ import annotations

import numpy as np

from hybridlio.core import se3
from hybridlio.core.estimates import RelativePose
from hybridlio.core.sensors import Scan
from hybridlio.localization.recent_path import RecentPath
from hybridlio.record.loop_keyframes import LoopKeyframeSettings


def test_a_long_run_keeps_its_last_keyframes_alone(rng: np.random.Generator):
    points = rng.uniform(-40, 40, (2000, 3)).astype(np.float32)
    step = RelativePose(se3.make(np.eye(3), np.array([1.0, 0.0, 0.0])), 1e-6 * np.eye(6), "test")
    path, up = RecentPath(LoopKeyframeSettings(spacing_m=4.0), reach_m=10.0), np.array([0.0, 0.0, 1.0])
    pose, counts, newest = np.eye(4), [], []
    for k in range(1000):
        if path.add(Scan(10**8 * (k + 1), points), pose, step) and k > 200:
            places = path.places(up)
            counts.append(len(places))
            newest.append(places.travelled_m[-1])
        pose = pose @ step.pose
    assert max(counts) <= 76  # 300 scans, one metre apart, and one keyframe every four
    np.testing.assert_allclose(np.diff(newest[-20:]), 0.0, atol=1e-9)  # the newest is the last of 300 scans
