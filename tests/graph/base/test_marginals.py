"""Marginal covariances agree with the inverse of the whole information matrix, in every order and elimination."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import X

from hybridlio.graph.base import marginals
from hybridlio.graph.base.marginals import Marginals

POSES = 40


def with_loops(poses: int = POSES) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Return a chain with loops over 7 poses, at poses that fit it."""
    rng = np.random.default_rng(3)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    at = [gtsam.Pose3()]
    for _ in range(poses - 1):
        at.append(at[-1].compose(gtsam.Pose3.Expmap(rng.normal(0.0, 0.3, 6))))
    for k, pose in enumerate(at):
        values.insert(X(k), pose)
    graph.add(gtsam.PriorFactorPose3(X(0), at[0], gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)))
    for step in (1, 7):
        for k in range(0, poses - step, step):
            noise = gtsam.noiseModel.Diagonal.Sigmas(rng.uniform(0.01, 0.1, 6))
            graph.add(gtsam.BetweenFactorPose3(X(k), X(k + step), at[k].between(at[k + step]), noise))
    return graph, values


@pytest.mark.parametrize("by_qr", [False, True])
@pytest.mark.parametrize("large", [0, 10_000], ids=["METIS", "COLAMD"])
@pytest.mark.parametrize("poses", [(0,), (39,), (4, 5), (30, 2), (8, 39, 1)])
def test_covariances_are_blocks_of_the_inverse_in_the_order_asked_for(
    poses: tuple[int, ...], large: int, by_qr: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(marginals, "_LARGE", large)
    graph, values = with_loops()
    order = gtsam.Ordering()
    for k in range(POSES):
        order.push_back(X(k))
    whole = np.linalg.inv(graph.linearize(values).hessian(order)[0])
    rows = np.concatenate([np.arange(6 * k, 6 * k + 6) for k in poses])
    found = Marginals(graph, values, by_qr).covariance([X(k) for k in poses])
    expected = whole[np.ix_(rows, rows)]
    np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())
