"""The start of lidars that do not repeat their pattern is decided over several scans."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from resumed import check_resumed_at

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.estimates import RelativePose
from hybridlio.core.sensors import NS_PER_S, Frame, Scan
from hybridlio.datasets.registry import open_sequence
from hybridlio.odometry.config import Config
from hybridlio.odometry.estimate import Estimate
from hybridlio.odometry.odometry import Odometry
from hybridlio.simulation.kitti_writer import START_NS
from hybridlio.simulation.platforms.config import PlatformConfig
from hybridlio.simulation.platforms.recording import plan
from hybridlio.simulation.platforms.simulate import simulate_platform

# Two scans of this recording fit each other better 0.8 m and more away from where they were.
AMBIGUOUS = PlatformConfig(scene="campus", platform="handheld", lidar="mid360", seconds=1.0, seed=8003)


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> list[Frame]:
    return list(open_sequence(simulate_platform(tmp_path_factory.mktemp("walk"), AMBIGUOUS)))


def errors(estimates: list[Estimate]) -> list[Array]:
    """Return the tangent vectors from the estimates to the true poses."""
    stamps = np.array([estimate.stamp_ns for estimate in estimates])
    truth = plan(AMBIGUOUS).lidar_poses((stamps - START_NS) / NS_PER_S)
    truth = se3.inverse(truth[0]) @ truth
    return [se3.log(se3.between(one.pose, pose)) for one, pose in zip(estimates, truth, strict=True)]


def estimated(frames: list[Frame]) -> list[Estimate]:
    odometry = Odometry()
    return [odometry.step(frame) for frame in frames]


@pytest.fixture(scope="module")
def estimates(walk: list[Frame]) -> list[Estimate]:
    return estimated(walk)


def test_an_ambiguous_start_is_vague_and_then_right(estimates: list[Estimate]) -> None:
    found = errors(estimates)
    squared = [error @ np.linalg.solve(one.covariance, error) for one, error in zip(estimates, found, strict=True)]
    assert max(squared[1:]) < 25
    relative = [estimate.relative for estimate in estimates[1:]]
    assert all(isinstance(one, RelativePose) and one.ok for one in relative)
    sigmas_m = [one.translation_sigma_m for one in relative if one is not None]
    assert sigmas_m[0] > 0.3
    assert max(sigmas_m[4:]) < 0.02
    assert max(np.linalg.norm(error[3:]) for error in found[4:]) < 0.05


def test_the_decision_corrects_the_steps_before(estimates: list[Estimate]) -> None:
    deciding = next(k for k, one in enumerate(estimates) if one.relative is not None and one.relative.earlier_scans)
    relative = estimates[deciding].relative
    assert relative is not None
    assert [one.stamp_ns for one in relative.earlier_scans] == [one.stamp_ns for one in estimates[: deciding - 1]]
    assert np.trace(estimates[deciding].covariance[3:, 3:]) < np.trace(estimates[deciding - 1].covariance[3:, 3:]) / 100


@pytest.mark.parametrize("cut", [2])
def test_an_undecided_start_is_resumed_to_the_last_bit(walk: list[Frame], cut: int) -> None:
    check_resumed_at(cut, walk[:6], Config())


@pytest.mark.parametrize("cut", [1, 3])
def test_a_scan_without_points_ends_the_search_and_is_bridged(walk: list[Frame], cut: int) -> None:
    empty = [
        replace(f, scan=Scan(f.scan.stamp_ns, np.empty((0, 3), np.float32))) if f.index == cut else f for f in walk
    ]
    estimates = estimated(empty[: cut + 4])
    assert estimates[cut].relative is not None
    assert not estimates[cut].relative.ok
    assert estimates[cut + 1].relative is not None
