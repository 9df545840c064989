"""Scans of places that look alike along a direction, while nothing else knows the motion along it."""

from __future__ import annotations

import numpy as np
import pytest
from matching import corridor, guess

from hybridlio.core.motion_limits import unknown_motion_covariance
from hybridlio.core.sensors import Frame, Scan
from hybridlio.sources.recent_points import RecentPoints
from hybridlio.sources.scan_matching import ScanMatching

UNKNOWN = guess(np.eye(4), unknown_motion_covariance(0.1))


def closed(rng: np.random.Generator) -> np.ndarray:
    """Return points on the corridor, and on two walls across it."""
    across = np.column_stack([np.tile([-8.0, 8.0], 3000), rng.uniform(-3, 3, 6000), rng.uniform(-1.7, 3.0, 6000)])
    return np.concatenate([corridor(rng), across + 0.01 * rng.standard_normal(across.shape)])


def frame(k: int, points: np.ndarray) -> Frame:
    return Frame(k, Scan(k * 100_000_000, points.astype(np.float32)))


def test_no_number_of_scans_of_a_corridor_measures_an_unknown_speed(rng: np.random.Generator):
    """Their errors along it are the same, and all of a step's covariance adds up."""
    matching, information = ScanMatching(), []
    matching.start(frame(0, corridor(rng)))
    for k in range(1, 12):
        step = matching.refine(frame(k, corridor(rng)), UNKNOWN)
        assert len(step.degenerate) == 1
        assert (step.drift is None) == (k > 1)
        information.append(1 / step.covariance[3, 3])
    assert sum(information) < 2 / 0.5**2


@pytest.mark.parametrize("repeats", [True, False])
def test_what_seems_to_end_a_corridor_is_believed_at_once_only_of_a_lidar_with_dense_scans(
    repeats: bool, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(RecentPoints, "repeats", property(lambda _: repeats))
    matching, unobserved = ScanMatching(), []
    matching.start(frame(0, corridor(rng)))
    for k in range(1, 10):
        step = matching.refine(frame(k, (closed if k > 2 else corridor)(rng)), UNKNOWN)
        unobserved.append(len(step.degenerate))
    # the first scan with ends is matched to one without, and the second is the first that may find them
    assert unobserved == [1, 1, 1] + ([0, 0, 0, 0, 0, 0] if repeats else [1, 1, 1, 1, 0, 0])
