import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.errors import DataError
from hybridlio.core.trajectory import Trajectory
from hybridlio.evaluation.consistency import absolute_consistency, anees, bounds, pose_consistency, step_consistency


def random_covariances(rng: np.random.Generator, n: int, d: int) -> np.ndarray:
    scale = np.array([1e-3] * (d // 2) + [0.05] * (d - d // 2))
    roots = rng.normal(size=(n, d, d)) + 2 * np.eye(d)
    return scale[:, None] * (roots @ np.swapaxes(roots, 1, 2)) * scale


def draw(rng: np.random.Generator, covariances: np.ndarray) -> np.ndarray:
    return (np.linalg.cholesky(covariances) @ rng.normal(size=(*covariances.shape[:2], 1)))[..., 0]


@pytest.mark.parametrize("d", [1, 3, 6])
def test_errors_drawn_from_their_covariances_are_consistent(rng: np.random.Generator, d: int) -> None:
    covariances = random_covariances(rng, 4000, d)
    result = anees(draw(rng, covariances), covariances)
    assert result.consistent
    assert result.value == pytest.approx(1, abs=0.05)


def test_the_bounds_contain_95_percent_of_consistent_averages(rng: np.random.Generator) -> None:
    covariances = random_covariances(rng, 40, 3)
    inside = np.mean([anees(draw(rng, covariances), covariances).consistent for _ in range(1000)])
    assert inside == pytest.approx(0.95, abs=0.02)


@pytest.mark.parametrize("k", [0.25, 4.0])
def test_covariances_k_times_too_small_give_an_anees_of_k(rng: np.random.Generator, k: float) -> None:
    covariances = random_covariances(rng, 4000, 6)
    errors = draw(rng, covariances)
    result = anees(errors, covariances / k)
    assert result.value == pytest.approx(k * anees(errors, covariances).value)
    assert not result.consistent


def test_rotation_and_position_are_evaluated_separately(rng: np.random.Generator) -> None:
    covariances = random_covariances(rng, 4000, 6)
    errors = draw(rng, covariances)
    claimed = covariances.copy()
    claimed[:, 3:, 3:] /= 9
    claimed[:, :3, 3:] = claimed[:, 3:, :3] = 0
    result = pose_consistency(errors, claimed)
    assert result.rotation.consistent
    assert result.position.value == pytest.approx(9, rel=0.05)
    np.testing.assert_allclose(result.sigmas[:, 0] ** 2, claimed[:, 0, 0])


def test_the_bounds_approach_one_with_more_samples() -> None:
    wide, narrow = bounds(10, 3), bounds(10_000, 3)
    assert wide[0] < narrow[0] < 1 < narrow[1] < wide[1]
    assert bounds(1, 1) == pytest.approx((0.00098, 5.0239), rel=1e-2)  # from a table of χ² with one degree of freedom


def test_steps_with_right_perturbations_and_their_chain_are_consistent(rng: np.random.Generator) -> None:
    runs, n = 300, 12
    covariances = random_covariances(rng, n, 6)
    chained, per_step, position = [], [], []
    for _ in range(runs):
        true_steps = se3.exp(rng.normal(0, [0.05] * 3 + [1.0] * 3, (n, 6)))
        steps = true_steps @ se3.exp(-draw(rng, covariances))  # so that the truth is estimate·Exp(error)
        reference, poses, covariance = [np.eye(4)], [np.eye(4)], [np.zeros((6, 6))]
        for true_step, step, cov in zip(true_steps, steps, covariances, strict=True):
            reference.append(reference[-1] @ true_step)
            poses.append(poses[-1] @ step)
            covariance.append(se3.compose_covariance(covariance[-1], step, cov))
        truth = Trajectory(np.arange(n + 1), np.array(reference))
        estimate = Trajectory(np.arange(n + 1), np.array(poses), np.array(covariance))
        per_step.append(step_consistency(steps, covariances, truth).pose.value)
        whole = absolute_consistency(estimate, truth)
        chained.append(whole.pose.nees[-1])
        position.append(whole.position.nees[-1])
    assert np.mean(per_step) == pytest.approx(1, abs=0.05)
    low, high = bounds(runs, 6, 0.999)
    assert low < np.mean(chained) < high
    low, high = bounds(runs, 3, 0.999)
    assert low < np.mean(position) < high


def test_the_error_for_an_invalid_row_names_it(rng: np.random.Generator) -> None:
    covariances = random_covariances(rng, 10, 6)
    errors = draw(rng, covariances)
    covariances[7, 0, 0] = -1.0
    with pytest.raises(DataError, match="row 7: the covariance is not positive definite"):
        anees(errors, covariances)
    errors[4, 2] = np.nan
    with pytest.raises(DataError, match=r"row 4: .* not finite"):
        anees(errors, covariances)
    with pytest.raises(DataError, match=r"got \(10, 6\), \(10, 3, 3\)"):
        anees(errors, covariances[:, :3, :3])
    with pytest.raises(DataError, match=r"got \(0, 6\)"):
        anees(errors[:0], covariances[:0])


def test_numbers_of_steps_and_covariances_that_do_not_match_are_an_error() -> None:
    reference = Trajectory(np.arange(5), np.tile(np.eye(4), (5, 1, 1)))
    with pytest.raises(DataError, match="5 steps do not match 5 reference poses"):
        step_consistency(reference.poses, np.tile(np.eye(6), (5, 1, 1)), reference)
    with pytest.raises(DataError, match="0 covariances for 5"):
        absolute_consistency(reference, reference)
