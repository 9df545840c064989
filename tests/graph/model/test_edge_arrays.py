"""Edges as arrays: their residuals in the plane are those in space."""

from __future__ import annotations

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.graph.model.edge_arrays import Edges


@pytest.mark.parametrize("largest_turn", [0.0, 1e-9, 3.1])
def test_chi2_in_the_plane_is_that_of_the_same_edges_in_space(rng, largest_turn):
    xi = np.zeros((60, 6))
    xi[:, 2] = largest_turn * rng.uniform(-1, 1, 60)
    xi[:, 3:5] = 5 * rng.normal(size=(60, 2))
    errors, poses = se3.exp(xi), np.tile(np.eye(4), (60, 1, 1))
    A = rng.normal(size=(60, 3, 3))
    information = A @ np.swapaxes(A, 1, 2) + np.eye(3)
    in_space = np.tile(np.eye(6), (60, 1, 1))
    in_space[:, 2:5, 2:5] = information
    every = np.arange(60)
    T, consecutive = se3.inverse(errors), np.zeros(60, dtype=bool)
    flat = Edges(every, every, every, T, information, consecutive).chi2(poses)
    space = Edges(every, every, every, T, in_space, consecutive).chi2(poses)
    np.testing.assert_allclose(flat, space, rtol=1e-9)
    assert (flat > 0).all()
