"""What the loss says of how sure an answer is: laws that hold whatever the scans."""

from dataclasses import replace

import numpy as np
import pytest

from hybridlio.learned.losses.loss_judge import _SYSTEMATIC, Judged

SIGMA_M = 0.02
INFORMATION = np.diag([2e5, 3e5, 4e5, 900.0, 800.0, 1200.0])


def judged(step: np.ndarray, refined: bool = False) -> Judged:
    levers = np.sqrt(np.diag(INFORMATION)[:3] / np.diag(INFORMATION)[3:].mean())
    return Judged(np.eye(4), 0.01, 0.9, INFORMATION, levers, step, SIGMA_M, refined)


@pytest.mark.parametrize("refined", [False, True])
def test_covariances_are_true_where_answer_and_minimum_err_as_they_are_taken_to(refined):
    rng, at_rest = np.random.default_rng(0), judged(np.zeros(6))
    noise = at_rest.noise(1.0)
    of_answer = rng.multivariate_normal(np.zeros(6), noise, size=2000)
    of_minimum = rng.multivariate_normal(np.zeros(6), noise + _SYSTEMATIC, size=2000)
    found = []
    for answer, minimum in zip(of_answer, of_minimum, strict=True):
        # a pose that was taken from the minimum has no way left to go
        error, step = (minimum, np.zeros(6)) if refined else (answer, minimum - answer)
        found.append(error @ np.linalg.solve(judged(step, refined).covariance(1.0), error) / 6)
    # the part of the way that is the answer's error counts in full: rather too large than too small
    assert np.mean(found) == pytest.approx(1.0, abs=0.05) if refined else 0.7 < np.mean(found) < 1.0


def test_a_way_that_noise_does_not_explain_counts_in_full():
    step = np.array([0, 0, 0, 0.2, 0, 0])
    assert judged(step).is_off(1.0)
    assert judged(step).covariance(1.0)[3, 3] > 0.2**2
    near = judged(0.01 * step)
    assert not near.is_off(1.0)
    assert near.covariance(1.0)[3, 3] < near.noise(1.0)[3, 3] + near.step[3] ** 2


def test_an_unconstrained_direction_stays_loose_on_either_way():
    blind = INFORMATION.copy()
    blind[3, 3] = 0.0
    for refined in (False, True):
        found = replace(judged(np.full(6, 1e-4), refined), information=blind)
        assert found.degenerate.shape == (1, 6)
        assert found.covariance(1.0)[3, 3] > 100.0
        assert np.linalg.eigvalsh(found.covariance(1.0)).min() > 0
        assert found.covariance(1.0)[4, 4] < 1e-4
