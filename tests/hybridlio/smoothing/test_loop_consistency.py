from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.chi_square import chi_square_quantile
from hybridlio.smoothing.loop_consistency import (
    ConsistencySettings,
    LoopArrays,
    largest_consistent_set,
    odometry_chi2,
    pairwise_chi2,
    supported,
)
from hybridlio.smoothing.step_uncertainty import OdometryChain

LOOP_SIGMAS = np.r_[np.full(3, 2e-3), np.full(3, 0.03)]


@pytest.fixture(scope="module")
def chain(round_trip: Any) -> OdometryChain:
    return OdometryChain(round_trip.record.online, round_trip.record.relative)


def measured(drive: Any, pairs: np.ndarray, rng: np.random.Generator) -> LoopArrays:
    true = se3.between(drive.truth.poses[pairs[:, 0]], drive.truth.poses[pairs[:, 1]])
    poses = true @ se3.exp(LOOP_SIGMAS * rng.standard_normal((len(pairs), 6)))
    return LoopArrays(pairs[:, 0], pairs[:, 1], poses, np.tile(np.diag(LOOP_SIGMAS**2), (len(pairs), 1, 1)))


def pairs_of(count: int, rng: np.random.Generator) -> np.ndarray:
    return np.column_stack([rng.integers(0, 150, count), rng.integers(250, 440, count)])


def test_chi2_of_correct_loops_is_consistent_with_their_noise(loop_drive: Any):
    corners = [(0, 0), (60, 0), (60, 40), (0, 40), (0, 5), (60, 5)]
    of_odometry, of_pairs = [], []
    rng = np.random.default_rng(5)
    for seed in range(30):
        drive = loop_drive(seed, corners, clouds=False)
        chain = OdometryChain(drive.record.online, drive.record.relative)
        last = len(drive.truth) - 1
        pairs = np.array([[5, last - 30], [40, last - 3]])
        loops = measured(drive, pairs, rng)
        of_odometry += odometry_chi2(loops, chain, 1.0).tolist()
        of_pairs.append(pairwise_chi2(loops, chain, 1.0)[0, 1])
    # a χ² of six degrees of freedom has a mean of 6 and a variance of 12
    assert abs(np.mean(of_odometry) - 6) < 4 * np.sqrt(12 / 30)  # the two loops of a drive share its noise
    assert abs(np.mean(of_pairs) - 6) < 4 * np.sqrt(12 / 30)


def test_pairwise_chi2_is_symmetric(round_trip: Any, chain: OdometryChain):
    rng = np.random.default_rng(1)
    loops = measured(round_trip, pairs_of(12, rng), rng)
    order = rng.permutation(12)
    shuffled = LoopArrays(loops.earlier[order], loops.later[order], loops.poses[order], loops.covariances[order])
    table, other = pairwise_chi2(loops, chain, 1.0), pairwise_chi2(shuffled, chain, 1.0)
    np.testing.assert_array_equal(table, table.T)
    np.testing.assert_allclose(other, table[np.ix_(order, order)], rtol=0.1, atol=0.3)  # to first order of the errors


def test_wrong_loops_are_not_in_the_largest_consistent_set(round_trip: Any, chain: OdometryChain):
    rng = np.random.default_rng(2)
    loops = measured(round_trip, pairs_of(40, rng), rng)
    wrong = np.zeros(40, bool)
    wrong[rng.permutation(40)[:15]] = True
    off = se3.exp(np.column_stack([rng.normal(0, 0.2, (15, 3)), rng.normal(0, 15.0, (15, 3))]))
    loops.poses[wrong] = loops.poses[wrong] @ off
    agree = pairwise_chi2(loops, chain, 1.0) <= chi_square_quantile(0.999, 6)
    kept = largest_consistent_set(agree)
    assert not (kept & wrong).any()
    assert kept.sum() >= 0.9 * (~wrong).sum()


def test_the_set_agrees_pairwise_and_cannot_be_extended(rng: np.random.Generator):
    for density in (0.2, 0.5, 0.8):
        half = np.triu(rng.random((25, 25)) < density, 1)
        agree = half | half.T
        kept = largest_consistent_set(agree)
        inside = agree[np.ix_(kept, kept)]
        assert inside.sum() == kept.sum() * (kept.sum() - 1)
        assert not agree[~kept][:, kept].all(axis=1).any()


def test_the_greedy_set_is_almost_always_the_largest(rng: np.random.Generator):
    smaller = 0
    for _ in range(20):
        half = np.triu(rng.random((11, 11)) < 0.5, 1)
        agree = half | half.T
        sizes = (n for n in range(11, 0, -1) for some in combinations(range(11), n) if _all_agree(agree, some))
        smaller += int(largest_consistent_set(agree).sum() < next(sizes))
    assert smaller <= 1


def _all_agree(agree: np.ndarray, some: tuple[int, ...]) -> bool:
    return all(agree[a, b] for a, b in combinations(some, 2))


def test_a_loop_is_supported_by_another_nearby_that_agrees(rng: np.random.Generator):
    travelled = np.arange(500.0)
    earlier, later = np.array([10, 14, 60, 64, 10]), np.array([300, 304, 350, 420, 300])
    nothing = np.zeros((5, 4, 4)), np.zeros((5, 6, 6))
    loops = LoopArrays(earlier, later, *nothing)
    settings = ConsistencySettings(support_reach_m=20.0)
    assert supported(loops, np.ones((5, 5), bool), travelled, settings).tolist() == [True, True, False, False, True]
    assert not supported(loops, np.zeros((5, 5), bool), travelled, settings).any()


def test_loops_of_the_same_scans_do_not_support_each_other():
    loops = LoopArrays(np.array([10, 10]), np.array([300, 300]), np.zeros((2, 4, 4)), np.zeros((2, 6, 6)))
    assert not supported(loops, np.ones((2, 2), bool), np.arange(500.0), ConsistencySettings()).any()
