"""Properties of the covariance that hold for any scans."""

from dataclasses import replace

import numpy as np
import pytest

from hybridlio.learned.losses.loss_evaluator import _SYSTEMATIC, EvaluatedPose

SIGMA_M = 0.02
INFORMATION = np.diag([2e5, 3e5, 4e5, 900.0, 800.0, 1200.0])


def evaluated(step: np.ndarray, refined: bool = False) -> EvaluatedPose:
    levers = np.sqrt(np.diag(INFORMATION)[:3] / np.diag(INFORMATION)[3:].mean())
    return EvaluatedPose(np.eye(4), 0.01, 0.9, INFORMATION, levers, step, SIGMA_M, refined)


@pytest.mark.parametrize("refined", [False, True])
def test_the_covariance_is_consistent_where_answer_and_minimum_have_the_assumed_errors(refined):
    rng, at_rest = np.random.default_rng(0), evaluated(np.zeros(6))
    noise = at_rest.noise(1.0)
    of_answer = rng.multivariate_normal(np.zeros(6), noise, size=2000)
    of_minimum = rng.multivariate_normal(np.zeros(6), noise + _SYSTEMATIC, size=2000)
    found = []
    for answer, minimum in zip(of_answer, of_minimum, strict=True):
        # a refined pose is the minimum itself
        error, step = (minimum, np.zeros(6)) if refined else (answer, minimum - answer)
        found.append(error @ np.linalg.solve(evaluated(step, refined).covariance(1.0), error) / 6)
    # the part of the step that is the answer's error enters in full: conservative
    assert np.mean(found) == pytest.approx(1.0, abs=0.05) if refined else 0.7 < np.mean(found) < 1.0


def test_a_distance_to_the_minimum_that_noise_does_not_explain_enters_in_full():
    step = np.array([0, 0, 0, 0.2, 0, 0])
    assert evaluated(step).is_off(1.0)
    assert evaluated(step).covariance(1.0)[3, 3] > 0.2**2
    near = evaluated(0.01 * step)
    assert not near.is_off(1.0)
    assert near.covariance(1.0)[3, 3] < near.noise(1.0)[3, 3] + near.step[3] ** 2


def test_an_unconstrained_direction_keeps_a_large_covariance_refined_or_not():
    blind = INFORMATION.copy()
    blind[3, 3] = 0.0
    for refined in (False, True):
        found = replace(evaluated(np.full(6, 1e-4), refined), information=blind)
        assert found.degenerate.shape == (1, 6)
        assert found.covariance(1.0)[3, 3] > 100.0
        assert np.linalg.eigvalsh(found.covariance(1.0)).min() > 0
        assert found.covariance(1.0)[4, 4] < 1e-4
