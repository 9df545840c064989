"""Starts of a search after bridged scans, and the covariance that the bridges have added up to."""

from __future__ import annotations

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.estimates import RelativePose
from hybridlio.sources.matching_state import PathPoint
from hybridlio.sources.refinding import starts_within


def test_starts_lie_all_over_the_region_and_the_likeliest_comes_first():
    T = se3.exp([0, 0, 0.3, 5, 2, 0])
    covariance = np.diag([1e-6, 1e-6, 1e-6, 2.0**2, 0.8**2, 0.01**2])
    starts = np.array(starts_within(T, covariance, 1.0))
    np.testing.assert_allclose(starts[0], T, atol=1e-12)
    offsets = se3.log(se3.between(np.broadcast_to(T, starts.shape), starts))[:, 3:]
    assert len(starts) == 11 * 5
    np.testing.assert_allclose(np.ptp(offsets, axis=0), [10, 4, 0], atol=1e-6)


def test_a_rotation_about_a_far_point_is_searched_as_one():
    lever = np.array([0, 0, 0.2, 0, 10 * 0.2, 0])  # turned about a point 10 m behind
    covariance = np.outer(lever, lever) + 1e-8 * np.eye(6)
    tangents = np.array([se3.log(T) for T in starts_within(np.eye(4), covariance, 1.0)])
    moved = tangents[np.abs(tangents[:, 4]) > 0.1]
    assert len(moved) >= 10
    np.testing.assert_allclose(moved[:, 2] * 10, moved[:, 4], atol=0.01)


def test_a_region_too_large_for_a_search_has_its_likeliest_place_only():
    assert len(starts_within(np.eye(4), np.diag([1e-6, 1e-6, 1e-6, 400.0, 400.0, 400.0]), 1.0)) == 1


@pytest.mark.parametrize("steps", [1, 5, 40])
def test_errors_of_bridges_add_up_as_those_of_one_wrong_velocity(steps: int):
    step = RelativePose(se3.exp([0, 0, 0, 1.0, 0, 0]), np.diag([1e-10] * 3 + [0.1**2] * 3), source="test")
    point = PathPoint(np.eye(4))
    for _ in range(steps):
        point = point.bridged_by(step)
    assert point.sigma_m == pytest.approx(steps * 0.1 * np.sqrt(3), rel=0.01)
