"""What matched points say of a pose: the lever arms that rotations are compared at."""

import numpy as np

from hybridlio.information import covariance_of, degenerate_directions, lever_arms


def test_in_a_long_narrow_corridor_roll_is_known(rng: np.random.Generator):
    """At one lever for all rotations, 17 m here, walls and floor 2 m away would seem to say nothing of roll."""
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
