"""The chordal start recovers exact measurements, whatever the graph's dimension, size and order of elimination."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from hybridlio.core import se3
from hybridlio.graph.base import elimination
from hybridlio.graph.model.edge_arrays import Edges
from hybridlio.graph.solve import chordal

COUNT = 400


def exact_edges(rng: np.random.Generator, planar: bool) -> tuple[np.ndarray, Edges]:
    """Return poses ``(N, 4, 4)`` and edges along them, with random loops, of random information."""
    xi = 0.3 * rng.normal(size=(COUNT, 6))
    if planar:
        xi[:, [0, 1, 5]] = 0.0
    poses = np.tile(np.eye(4), (COUNT, 1, 1))
    for k in range(1, COUNT):
        poses[k] = poses[k - 1] @ se3.exp(xi[k])
    i = np.r_[np.arange(COUNT - 1), rng.integers(0, COUNT // 2, 60)]
    j = np.r_[np.arange(1, COUNT), rng.integers(COUNT // 2, COUNT, 60)]
    size = 3 if planar else 6
    information = rng.uniform(0.5, 2, len(i))[:, None, None] * np.eye(size)
    T = se3.between(poses[i], poses[j])
    return poses, Edges(np.arange(len(i)), i, j, T, information, np.abs(i - j) == 1)


@pytest.mark.parametrize("planar", [True, False])
@pytest.mark.parametrize("large", [10, 10_000])
def test_exact_edges_give_the_poses_in_either_order_of_elimination(rng, monkeypatch, planar, large):
    monkeypatch.setattr(elimination, "_LARGE", large)
    poses, edges = exact_edges(rng, planar)
    roots = {0: poses[0], 123: poses[123]}
    assert_allclose(chordal.chordal_poses(roots, COUNT, edges), poses, atol=1e-8)


def test_nested_dissection_and_minimum_degree_order_every_unknown_once(rng, monkeypatch):
    _, edges = exact_edges(rng, planar=True)
    known = np.zeros(COUNT, dtype=bool)
    known[[5, 77]] = True
    for large in (10, 10_000):
        monkeypatch.setattr(elimination, "_LARGE", large)
        order = elimination.elimination_order(known, edges.i, edges.j)
        assert sorted(order.tolist()) == np.flatnonzero(~known).tolist()


def test_the_nearest_planar_rotation_is_that_of_the_singular_value_decomposition(rng):
    matrices = rng.normal(size=(50, 2, 2))
    lifted = np.tile(np.eye(3), (50, 1, 1))
    lifted[:, :2, :2] = matrices
    turned = np.linalg.det(matrices) > 0  # a reflection's nearest rotation in space leaves the plane
    expected = se3.orthonormalise(se3.make(lifted, np.zeros(3)))[turned, :3, :3]
    assert_allclose(chordal._nearest_rotations(matrices)[turned], expected, atol=1e-12)
