"""Covariance, degenerate directions and step from a Hessian, with one lever arm per axis."""

import numpy as np
import pytest

from hybridlio.registration.information import covariance_of, degenerate_directions, lever_arms, newton_step


def test_roll_is_constrained_in_a_long_narrow_corridor(rng: np.random.Generator):
    """With one lever arm for all axes, 17 m here, walls and floor 2 m away would not constrain roll."""
    count = 6000
    x, side = rng.uniform(-60, 60, count), np.where(np.arange(count) % 3 == 0, 0, np.sign(np.arange(count) % 3 - 1.5))
    across, height = np.where(side == 0, rng.uniform(-1.2, 1.2, count), 1.2 * side), rng.uniform(-1, 1, count)
    points = np.column_stack([x, across, np.where(side == 0, -1.0, height)])
    normals = np.where(side[:, None] == 0, [0.0, 0.0, 1.0], [0.0, 1.0, 0.0])
    J = np.hstack([np.cross(points, normals), normals])
    information = J.T @ J
    levers_m = lever_arms(points)
    np.testing.assert_allclose(levers_m, [np.hypot(*points.std(axis=0)[1:]), 34.6, 34.6], rtol=0.1)
    along = degenerate_directions(information, levers_m)
    assert len(along) == 1
    assert abs(along[0, 3]) > 0.99
    assert len(degenerate_directions(information)) == 2
    sigma_rad = np.sqrt(covariance_of(information, 0.02, 6.0, levers_m)[0, 0])
    assert sigma_rad < 2e-3
    assert np.sqrt(covariance_of(information, 0.02, 6.0)[0, 0]) > 0.1


def spread(*weak: int) -> np.ndarray:
    return np.diag([0.0 if axis in weak else 1000.0 * (25.0 if axis < 3 else 1.0) for axis in range(6)])


def test_the_covariance_is_the_inverse_of_full_information():
    found = covariance_of(spread(), sigma_m=0.02, scale=1.0)
    # the normal noise, 2e-3 of the translation block's trace of 3000, is subtracted
    assert np.sqrt(found[4, 4] - 1e-6) == pytest.approx(0.02 / np.sqrt(994), rel=1e-3)
    assert degenerate_directions(spread()).shape == (0, 6)


def test_directions_without_information_have_no_step_and_10_m():
    found = covariance_of(spread(3), sigma_m=0.02, scale=1.0)
    assert found[3, 3] == pytest.approx(100.0)
    assert np.abs(degenerate_directions(spread(3))).argmax(axis=1).tolist() == [3]
    step = newton_step(spread(3), np.array([0, 0, 0, 50.0, 50.0, 0]))
    assert step[3] == 0
    assert step[4] == pytest.approx(-0.05)
