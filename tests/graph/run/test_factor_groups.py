from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import X
from online_runs import composed

from hybridlio.core import se3
from hybridlio.core.errors import ConfigError
from hybridlio.core.estimates import State
from hybridlio.graph.run.factor_groups import GroupFactors, GroupSolution, PossibleOutlier
from hybridlio.graph.run.robust import ROBUST_METHODS
from hybridlio.graph.run.smooth import smooth

SIGMAS = np.r_[np.full(3, 2e-3), np.full(3, 0.03)]
PAIRS = [(k, k + 30) for k in range(0, 30, 2)]
WRONG = [3, 4, 9]


class Pairs:
    """Relative poses of scans far apart, some of them wrong by metres."""

    name = "pairs"
    robust: str | None = "gnc"

    def __init__(self, poses: np.ndarray, wrong: Sequence[int], seed: int) -> None:
        rng = np.random.default_rng(seed)
        noise = SIGMAS * rng.standard_normal((len(PAIRS), 6))
        noise[list(wrong)] += np.r_[np.zeros(3), 3.0, -2.0, 1.0]
        i, j = np.array(PAIRS).T
        self.steps = se3.between(poses[i], poses[j]) @ se3.exp(noise)

    def build(self, states: Sequence[State], previous: gtsam.Values | None) -> GroupFactors:
        del states, previous
        return GroupFactors(possible_outliers=[self._one(*pair, T) for pair, T in zip(PAIRS, self.steps, strict=True)])

    def _one(self, i: int, j: int, step: np.ndarray) -> PossibleOutlier:
        T = gtsam.Pose3(step)
        return PossibleOutlier(
            lambda model: gtsam.BetweenFactorPose3(X(i), X(j), T, model), np.diag(SIGMAS**2), f"{i}-{j}"
        )

    def read(self, solution: GroupSolution) -> Any:
        return solution


def rmse(smoothed: Any, drive: Any) -> float:
    return float(np.sqrt(((smoothed.trajectory.poses - drive.lidar_poses)[:, :3, 3] ** 2).sum(axis=1).mean()))


@pytest.fixture(scope="module")
def drive(chain: Callable[..., Any]) -> Any:
    return chain(31, steps=60)


@pytest.mark.parametrize("robust", ROBUST_METHODS)
def test_outliers_of_a_group_do_not_distort_the_path(drive: Any, robust: str):
    record = drive.record(composed(drive))
    clean = smooth(record, groups=[Pairs(drive.poses, [], 1)])
    bent = smooth(record, groups=[Pairs(drive.poses, WRONG, 1)], robust=robust)
    naive = Pairs(drive.poses, WRONG, 1)
    naive.robust = None
    assert rmse(smooth(record, groups=[naive]), drive) > 10 * rmse(clean, drive)
    assert rmse(bent, drive) < 2 * rmse(clean, drive) + 0.02
    solution = bent.found["pairs"]
    weights = np.delete(solution.weights, WRONG)
    assert solution.weights[WRONG].max() < 0.15 < weights.min()
    if robust == "gnc":
        assert solution.weights[WRONG].max() == 0
        assert weights.min() == 1


def test_a_group_gets_covariances_of_the_solved_graph(drive: Any):
    smoothed = smooth(drive.record(composed(drive)), groups=[Pairs(drive.poses, [], 1)])
    solution = smoothed.found["pairs"]
    joint = solution.covariance([X(10), X(40)])
    T = drive.calibration.T_imu_lidar
    np.testing.assert_allclose(
        se3.rotate_covariance(joint[6:, 6:], se3.inverse(T)), smoothed.trajectory.covariances[40], rtol=1e-6, atol=1e-12
    )
    assert [state.stamp_ns for state in solution.states] == smoothed.trajectory.stamps_ns.tolist()


def test_an_unknown_robust_method_is_rejected(drive: Any):
    with pytest.raises(ConfigError, match=r"no 'magic'.*huber.*gnc"):
        smooth(drive.record(composed(drive)), robust="magic")


def test_an_unknown_robust_method_is_rejected_before_the_search_for_loops(drive: Any):
    stages: list[str] = []
    with pytest.raises(ConfigError, match="no 'magic'"):
        smooth(drive.record(composed(drive)), lambda stage, *_: stages.append(stage), loops=True, robust="magic")
    assert stages == []
