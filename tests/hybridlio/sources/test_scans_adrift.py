"""Scans of places that look alike along a direction, while nothing else knows the motion along it."""

from __future__ import annotations

import numpy as np
import pytest
from matching import guess

from hybridlio.core.motion_limits import unknown_motion_covariance
from hybridlio.core.sensors import Frame, Scan
from hybridlio.sources.recent_points import RecentPoints
from hybridlio.sources.scan_matching import ScanMatching

UNKNOWN = guess(np.eye(4), unknown_motion_covariance(0.1))


def passage(rng: np.random.Generator, ends: bool = False) -> np.ndarray:
    """Return points on a floor and two walls along x, 6 m apart, and on two walls that close them."""
    x = rng.uniform(-25, 25, (30000, 1))
    height = rng.uniform(-1.7, 3.0, (20000, 1))
    floor = np.hstack([x[:10000], rng.uniform(-3, 3, (10000, 1)), np.full((10000, 1), -1.7)])
    walls = np.hstack([x[10000:], np.where(np.arange(20000) < 10000, -3.0, 3.0)[:, None], height])
    across = np.column_stack([np.tile([-8.0, 8.0], 3000), rng.uniform(-3, 3, 6000), rng.uniform(-1.7, 3.0, 6000)])
    points = np.concatenate([floor, walls, across] if ends else [floor, walls])
    return points + 0.01 * rng.standard_normal(points.shape)


def frame(k: int, points: np.ndarray) -> Frame:
    return Frame(k, Scan(k * 100_000_000, points.astype(np.float32)))


def test_no_number_of_scans_of_a_corridor_measures_an_unknown_speed(rng: np.random.Generator):
    """Their errors along it are the same, and all of a step's covariance adds up."""
    matching, information = ScanMatching(), []
    matching.start(frame(0, passage(rng)))
    for k in range(1, 12):
        step = matching.refine(frame(k, passage(rng)), UNKNOWN)
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
    matching.start(frame(0, passage(rng)))
    for k in range(1, 10):
        step = matching.refine(frame(k, passage(rng, ends=k > 2)), UNKNOWN)
        unobserved.append(len(step.degenerate))
    # the first scan with ends is matched to one without, and the second is the first that may find them
    assert unobserved == [1, 1, 1] + ([0, 0, 0, 0, 0, 0] if repeats else [1, 1, 1, 1, 0, 0])
