"""Guesses and scans for tests of scan matching."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hybridlio.core import se3
from hybridlio.core.estimates import RelativePose
from hybridlio.core.sensors import Frame, Scan
from hybridlio.datasets.sequence import Sequence

SURE = np.diag(np.r_[np.full(3, 0.01), np.full(3, 0.1)] ** 2)
OFF = se3.exp(np.array([0.003, -0.002, 0.005, 0.12, -0.08, 0.05]))


def true_pose(sequence: Sequence, i: int, j: int) -> np.ndarray:
    assert sequence.reference is not None
    return se3.between(sequence.reference.poses[i], sequence.reference.poses[j])


def guess(pose: np.ndarray, covariance: np.ndarray = SURE) -> RelativePose:
    return RelativePose(pose, covariance, "guess")


def with_points(frame: Frame, points: np.ndarray, stamp_ns: int | None = None) -> Frame:
    return replace(frame, scan=Scan(stamp_ns or frame.scan.stamp_ns, points.astype(np.float32)))


def empty(frame: Frame) -> Frame:
    return with_points(frame, np.empty((0, 3)))


def corridor(rng: np.random.Generator) -> np.ndarray:
    """Return points on a floor and two walls along x, 6 m apart."""
    x = rng.uniform(-25, 25, (30000, 1))
    across = rng.uniform(-3, 3, (10000, 1))
    height = rng.uniform(-1.7, 3.0, (20000, 1))
    floor = np.hstack([x[:10000], across, np.full((10000, 1), -1.7)])
    walls = np.hstack([x[10000:], np.where(np.arange(20000) < 10000, -3.0, 3.0)[:, None], height])
    return np.concatenate([floor, walls]) + 0.01 * rng.standard_normal((30000, 3))
