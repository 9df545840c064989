import numpy as np
import pytest

from hybridlio.graph.base.truncated_squares import chi2_bound, first_control, graduate, truncated_weights


def test_weights_go_from_nearly_quadratic_to_truncated():
    chi2, bound = np.array([0.0, 5.0, 9.9, 10.1, 20.0, 1e6]), 10.0
    soft, hard = truncated_weights(chi2, bound, 1e-6), truncated_weights(chi2, bound, 1e6)
    np.testing.assert_array_equal(hard, [1, 1, 1, 0, 0, 0])
    assert soft[0] == 1
    assert (np.diff(soft) <= 0).all()
    assert (soft[1:] > 0).all()


def test_the_first_control_parameter_keeps_the_largest_residual_at_a_positive_weight():
    chi2, bound = np.array([0.1, 5.0, 1e6]), chi2_bound(6)
    weights = truncated_weights(chi2, bound, first_control(float(chi2.max()), bound))
    assert (weights > 0).all()
    assert first_control(0.5 * bound, bound) == 1.0  # no residual beyond the bound: one step decides


def test_a_larger_bound_is_needed_for_more_dimensions():
    assert chi2_bound(3) == pytest.approx(11.345, abs=1e-3)
    assert chi2_bound(6) == pytest.approx(16.812, abs=1e-3)


def test_graduation_ends_where_no_residual_is_truncated():
    solved: list[float] = []

    def solve(state: float, weights: np.ndarray) -> float:
        solved.append(state)
        return 1.0

    assert graduate(0.0, lambda _: np.array([9.0, 8.0]), solve, 10.0)[1].tolist() == [1, 1]
    assert not solved
    state, weights = graduate(0.0, lambda state: np.array([9.0, 30.0]) * (1 - 0.9 * state), solve, 10.0)
    assert (state, weights.tolist(), len(solved)) == (1.0, [1, 1], 1)
