"""What is believed of registrations where nothing knows the position along a direction, scan after scan."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybridlio.core.arrays import Array
from hybridlio.registration.information import UNKNOWN_SIGMA_M
from hybridlio.registration.results import ObservedRegistration, Registration

LEVER_ARMS_M, NOISE = np.array([2.0, 20.0, 20.0]), 1.2e-3
ALONG, NOTHING = np.eye(6)[3:4], np.empty((0, 6))
GUESS_M = 0.5


def registered(is_observed: bool, count: int = 1) -> ObservedRegistration:
    """Return a registration of ten points in a tunnel along x, which is a weak direction if ``count`` is 1."""
    hessian = 10 * np.diag(np.r_[LEVER_ARMS_M**2, 1e-3 if count else 1.0, 1.0, 1.0])
    found = Registration(np.eye(4), hessian, LEVER_ARMS_M, 0.02, 1.0, 0.2, 5, True)
    basis, observed = np.eye(6)[:, 3 : 3 + count], np.full(count, is_observed)
    return ObservedRegistration(found, basis, ALONG[:count], observed, np.full(count, GUESS_M), NOISE)


def sigmas(observed: ObservedRegistration) -> Array:
    return np.sqrt(np.diag(observed.covariance(1.0)))


def test_any_number_of_guesses_in_a_row_says_no_more_than_two_alone() -> None:
    """They have one error: what the lidar's own pattern, at rest relative to it, does to the costs."""
    guesses = [registered(False).adrift(k, NOTHING) for k in range(1, 200)]
    information = np.array([1 / one.weak_sigmas_m[0] ** 2 for one in guesses])
    assert information.sum() <= 2 / GUESS_M**2
    assert information[0] == pytest.approx(1 / GUESS_M**2)


def test_one_scan_alone_is_believed_as_it_is() -> None:
    """Most starts have one, whose map is a single scan."""
    observed = registered(False)
    assert observed.adrift(1, NOTHING) is observed


def test_what_observes_the_direction_counts_in_full() -> None:
    assert registered(True).adrift(7, NOTHING).weak_sigmas_m == [GUESS_M]


def test_an_unknown_way_along_planes_that_lean_makes_distances_from_them_uncertain() -> None:
    """In all directions: in a tunnel, 0.7 mrad of roll for each metre became a measurement of the speed."""
    before, after = sigmas(registered(False)), sigmas(registered(False).adrift(2, NOTHING))
    leaning_m = UNKNOWN_SIGMA_M * np.sqrt(NOISE)
    strong = [0, 1, 2, 4, 5]
    np.testing.assert_allclose(after[strong] / before[strong], leaning_m / 0.02, rtol=0.05)


def test_a_direction_that_is_disbelieved_is_unobserved() -> None:
    first = registered(True, count=0).adrift(3, ALONG)
    np.testing.assert_array_equal(first.degenerate, ALONG)
    assert sigmas(first)[3] == pytest.approx(UNKNOWN_SIGMA_M, rel=0.01)
    second = registered(True, count=0).adrift(4, NOTHING)
    assert not len(second.degenerate)
    assert sigmas(second)[3] < UNKNOWN_SIGMA_M / 10


def test_a_direction_that_is_unobserved_anyway_is_not_counted_twice() -> None:
    observed = replace(registered(False), weak_sigmas_m=np.array([UNKNOWN_SIGMA_M])).adrift(2, ALONG)
    assert len(observed.degenerate) == 1
    assert sigmas(observed)[3] == pytest.approx(UNKNOWN_SIGMA_M, rel=0.01)
