"""Weak directions of a registration are weighed with the IMU's prediction by their information."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.registration.results import ObservedRegistration, Registration

LEVER_ARMS_M = np.array([4.0, 5.0, 6.0])
START = se3.exp(np.array([0.1, 0.2, -0.3, 1.0, 2.0, 3.0]))
MOVED_M = 0.1


def registered(sigmas_m: list[float]) -> ObservedRegistration:
    """Return a registration that has moved by :data:`MOVED_M` along x, y, …, as many as are weak."""
    count = len(sigmas_m)
    basis, tangents = np.zeros((6, count)), np.zeros((count, 6))
    basis[3 : 3 + count], tangents[:, 3 : 3 + count] = np.eye(count), np.eye(count)
    pose = START @ se3.exp(MOVED_M * tangents.sum(axis=0))
    found = Registration(pose, np.eye(6), LEVER_ARMS_M, 0.02, 1.0, 0.2, 5, True)
    return ObservedRegistration(found, basis, tangents, np.ones(count, bool), np.array(sigmas_m), 1e-3)


def predicted(sigma_m: float) -> Array:
    return np.diag(np.r_[np.full(3, 1e-6), np.full(3, sigma_m**2)])


@pytest.mark.parametrize(
    ("scan_m", "imu_m", "share"), [(0.05, 0.05, 0.5), (0.05, 5.0, 1.0), (0.05, 5e-4, 0.0), (0.03, 0.04, 16 / 25)]
)
def test_each_side_counts_by_its_information(scan_m: float, imu_m: float, share: float) -> None:
    pose, covariance = registered([scan_m]).weighed_with(START, predicted(imu_m))
    moved = se3.log(se3.between(START, pose))
    np.testing.assert_allclose(moved, [0, 0, 0, share * MOVED_M, 0, 0], atol=2e-5)
    assert covariance[3, 3] == pytest.approx(1 / (1 / scan_m**2 + 1 / imu_m**2))
    assert np.count_nonzero(covariance) == 1


def test_weak_directions_are_weighed_each_by_itself() -> None:
    pose, covariance = registered([0.05, 5.0]).weighed_with(START, predicted(0.05))
    moved = se3.log(se3.between(START, pose))
    np.testing.assert_allclose(moved[3:], [0.5 * MOVED_M, 0, 0], atol=1e-4)
    assert covariance[4, 4] == pytest.approx(0.05**2, rel=1e-3)


def test_without_weak_directions_the_registration_stays() -> None:
    observed = registered([])
    pose, covariance = observed.weighed_with(START, predicted(1e-3))
    assert pose is observed.registration.pose
    assert not covariance.any()


def test_deviations_of_settled_directions_are_scaled_as_those_of_strong_ones() -> None:
    observed = replace(registered([0.02, 10.0]), is_observed=np.array([True, False]), is_settled=True)
    for scale in (1.0, 5.0):
        covariance = observed.covariance(scale)
        assert np.sqrt(covariance[3, 3]) == pytest.approx(np.sqrt(scale) * 0.02, rel=0.05)
        assert np.sqrt(covariance[4, 4]) == pytest.approx(10.0)
