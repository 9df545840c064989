from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.smoothing.step_uncertainty import OdometryChain


@pytest.fixture(scope="module")
def chain(round_trip: Any) -> OdometryChain:
    return OdometryChain(round_trip.record.online, round_trip.record.relative)


def compounded(record: Any, i: int, j: int) -> np.ndarray:
    """The covariance from scan i to scan j, compounded step by step."""
    covariance = np.zeros((6, 6))
    for step in record.relative[i:j]:
        covariance = se3.compose_covariance(covariance, step.pose, step.covariance)
    return covariance


@pytest.mark.parametrize(("i", "j"), [(0, 439), (0, 1), (120, 121), (50, 300), (430, 439)])
def test_a_covariance_compounds_the_steps_in_between(chain: OdometryChain, round_trip: Any, i: int, j: int):
    expected = compounded(round_trip.record, i, j)
    np.testing.assert_allclose(chain.covariance(np.array(i), np.array(j)), expected, rtol=1e-6, atol=1e-12)


def test_the_inverse_relative_pose_has_the_same_uncertainty(chain: OdometryChain):
    i, j = np.array(40), np.array(333)
    there, back = chain.covariance(i, j), chain.covariance(j, i)
    np.testing.assert_allclose(se3.rotate_covariance(there, chain.relative(i, j)), back, rtol=1e-6, atol=1e-12)


def test_scatter_counts_at_both_ends_and_does_not_add_up(round_trip: Any):
    record = round_trip.record
    scatter = np.diag([1e-6, 1e-6, 1e-6, 1e-4, 1e-4, 1e-4])
    on_map = tuple(
        replace(step, covariance=step.covariance + 2 * scatter, drift=step.covariance) for step in record.relative
    )
    i, j = np.array(50), np.array(300)
    chain = OdometryChain(record.online, on_map)
    expected = compounded(record, 50, 300) + scatter
    expected += se3.rotate_covariance(scatter, se3.inverse(chain.relative(i, j)))
    np.testing.assert_allclose(chain.covariance(i, j), expected, rtol=1e-6, atol=1e-12)


def test_covariances_are_scaled_up_to_those_of_the_online_estimate(round_trip: Any, chain: OdometryChain):
    online = round_trip.record.online
    less_certain = OdometryChain(replace(online, covariances=4.0 * online.covariances), round_trip.record.relative)
    i, j = np.array([100, 200]), np.array([200, 400])
    np.testing.assert_allclose(less_certain.covariance(i, j), 4.0 * chain.covariance(i, j), rtol=1e-6)


def test_many_pairs_give_the_same_as_each_alone(chain: OdometryChain):
    i, j = np.array([[1, 20], [300, 4]]), np.array([[17, 3], [4, 300]])
    together, poses = chain.covariance(i, j), chain.relative(i, j)
    for at in np.ndindex(2, 2):
        np.testing.assert_allclose(together[at], chain.covariance(i[at], j[at]))
        np.testing.assert_allclose(poses[at], chain.relative(i[at], j[at]))
