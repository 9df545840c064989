"""Consistency of the incremental backend's covariances with its errors over many drives."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from online_runs import pose_error, run

from hybridlio.core import se3
from hybridlio.core.estimates import RelativePose, State
from hybridlio.evaluation.consistency import Anees, anees


@pytest.fixture(scope="module", params=[None, 0.02], ids=["steps", "map"])
def many(
    request: pytest.FixtureRequest, chain: Callable[..., Any]
) -> list[tuple[Any, list[State], list[RelativePose]]]:
    """Twenty-four drives of 2.5 s, each with its own biases, gravity and noise.

    The errors of their relative poses are independent, or those of registration to a slowly drifting map.
    """
    drives = [chain(seed, steps=25, drift_share=request.param) for seed in range(100, 124)]
    return [(drive, *run(drive)[1:]) for drive in drives]


def parts(errors: list[np.ndarray], covariances: list[np.ndarray]) -> dict[str, Anees]:
    e, c = np.array(errors), np.array(covariances)
    return {"rotation": anees(e[:, :3], c[:, :3, :3]), "position": anees(e[:, 3:], c[:, 3:, 3:])}


@pytest.mark.parametrize("part", ["rotation", "position"])
def test_covariances_of_poses_are_consistent(many: Any, part: str):
    # errors within a drive are correlated: its mean has a standard deviation of 0.5; the mean of all drives, 0.1
    errors = [pose_error(s, T) for drive, states, _ in many for s, T in zip(states, drive.poses[1:], strict=True)]
    covariances = [s.covariance[:6, :6] for _, states, _ in many for s in states]
    assert 0.8 < parts(errors, covariances)[part].value < 1.25


@pytest.mark.parametrize("part", ["rotation", "position"])
def test_covariances_of_steps_are_consistent(many: Any, part: str):
    errors, covariances = [], []
    for drive, _, steps in many:
        truth = se3.between(drive.lidar_poses[:-1], drive.lidar_poses[1:])
        errors += list(se3.log(se3.between(np.array([s.pose for s in steps]), truth)))
        covariances += [s.covariance for s in steps]
    assert 0.85 < parts(errors, covariances)[part].value < 1.15


@pytest.mark.parametrize(
    ("name", "block", "of_truth"),
    [
        ("velocity_m_s", slice(6, 9), "velocities"),
        ("accel_bias_m_s2", slice(9, 12), "accel_biases"),
        ("gyro_bias_rad_s", slice(12, 15), "gyro_biases"),
    ],
)
def test_covariances_of_velocity_and_biases_are_consistent(many: Any, name: str, block: slice, of_truth: str):
    errors, covariances = [], []
    for drive, states, _ in many:
        errors += list(np.array([getattr(s, name) for s in states]) - getattr(drive, of_truth)[1:])
        covariances += [s.covariance[block, block] for s in states]
    assert 0.6 < anees(np.array(errors), np.array(covariances)).value < 1.45


def test_the_covariance_of_gravity_is_consistent_after_a_second(many: Any):
    errors = [s.gravity_m_s2 - drive.gravity for drive, states, _ in many for s in states[10:]]
    covariances = [s.gravity_covariance for _, states, _ in many for s in states[10:]]
    # nearly constant along a drive: the mean of 24 values of three dimensions has a standard deviation of 0.17
    assert 0.5 < anees(np.array(errors), np.array(covariances)).value < 1.5


def test_twice_the_claimed_noise_is_inconsistent(chain: Callable[..., Any]):
    """The checks above can fail: relative poses with twice the claimed noise make them."""
    errors, covariances = [], []
    for seed in range(5):
        drive = chain(seed, steps=30, step_error=2.0)
        _, _, steps = run(drive)
        truth = se3.between(drive.lidar_poses[:-1], drive.lidar_poses[1:])
        errors += list(se3.log(se3.between(np.array([s.pose for s in steps]), truth)))
        covariances += [s.covariance for s in steps]
    assert parts(errors, covariances)["position"].value > 1.5
