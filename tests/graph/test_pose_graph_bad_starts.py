"""From any initial values, a public benchmark reaches the error that GTSAM reaches from good ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hybridlio.core import se3
from hybridlio.graph import PoseGraph

SPREAD_M = 50.0  # the sphere's radius


@pytest.fixture(scope="module")
def sphere(shared_data: Path) -> Path:
    return shared_data / "pose_graphs" / "sphere2500.g2o"


@pytest.fixture(scope="module")
def best(sphere: Path) -> float:
    """Return GTSAM's error from the initial values of the file."""
    graph, values = gtsam.readG2o(str(sphere), True)
    graph.add(gtsam.PriorFactorPose3(0, values.atPose3(0), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)))
    return float(graph.error(gtsam.GaussNewtonOptimizer(graph, values).optimize()))


def starts(count: int, seed: int | None) -> Any:
    """Return all poses at the identity (no seed), or random ones."""
    if seed is None:
        return np.tile(np.eye(4), (count, 1, 1))
    rng = np.random.default_rng(seed)
    return se3.make(Rotation.random(count, rng).as_matrix(), rng.uniform(-SPREAD_M, SPREAD_M, (count, 3)))


@pytest.mark.parametrize(("seed", "initial"), [(None, "auto"), (0, "auto"), (1, "chordal")])
def test_the_best_error_is_reached_from_any_start(sphere, best, seed, initial):
    graph = PoseGraph.load(sphere)
    for key, pose in zip(graph.keys, starts(len(graph), seed), strict=True):
        graph.set_initial(key, pose)
    solution = graph.optimize(initial=initial)
    assert solution.converged
    assert solution.error == pytest.approx(best, rel=1e-6)
