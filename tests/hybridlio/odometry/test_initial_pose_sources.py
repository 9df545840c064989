"""Initial-pose sources. Every registered implementation is tested against the same contract."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from contracts import bytes_of, check, start_of, true_state, true_step

from hybridlio.core import se3
from hybridlio.core.estimates import InitialPoseSource, RelativePose
from hybridlio.core.sensors import Frame, ImuSamples
from hybridlio.datasets.sequence import Sequence
from hybridlio.odometry.registry import INITIAL_POSE_SOURCES
from hybridlio.odometry.setup import Setup

INITIAL = sorted(INITIAL_POSE_SOURCES)


@pytest.mark.parametrize("name", INITIAL)
def test_an_initial_pose_source_predicts_and_learns_along_a_drive(
    name: str, setup: Setup, sequence: Sequence, first_frames: list[Frame]
):
    source: InitialPoseSource = INITIAL_POSE_SOURCES[name](setup)
    assert source.name == name
    state, off = start_of(first_frames), []
    for k in range(1, len(first_frames)):
        predicted = source.predict(first_frames[k], state)
        check(predicted, {name})
        truth = true_step(sequence, k - 1, k)
        error = se3.log(se3.between(predicted.pose, truth.pose))
        off.append(np.sqrt(error @ np.linalg.solve(predicted.covariance, error)))
        source.correct(first_frames[k], truth)
        state = true_state(sequence, k, state)
    assert max(off) < 5  # Mahalanobis distance in six dimensions; 4.6 is exceeded once in a thousand


@pytest.mark.parametrize("name", INITIAL)
def test_an_initial_pose_source_starts_with_an_unknown_speed(name: str, setup: Setup, first_frames: list[Frame]):
    predicted = INITIAL_POSE_SOURCES[name](setup).predict(first_frames[1], start_of(first_frames))
    assert np.linalg.norm(predicted.pose[:3, 3]) < 0.5
    assert 3 * np.sqrt(predicted.covariance[3, 3]) > 3.0  # 30 m/s for 0.1 s


@pytest.mark.parametrize("name", INITIAL)
def test_an_initial_pose_source_predicts_over_missing_scans(
    name: str, setup: Setup, sequence: Sequence, first_frames: list[Frame]
):
    source, state, at = INITIAL_POSE_SOURCES[name](setup), start_of(first_frames), 0
    spreads = {}
    for k in (1, 2, 3, 6, 7):
        imu = sequence.imu.between(state.stamp_ns, first_frames[k].scan.stamp_ns)
        frame = replace(first_frames[k], imu=imu)
        predicted = source.predict(frame, state)
        check(predicted, {name})
        truth = true_step(sequence, at, k)
        if k > 3:
            spreads[k - at] = np.sqrt(np.trace(predicted.covariance[3:, 3:]))
            if name != "identity":
                assert np.linalg.norm(se3.between(predicted.pose, truth.pose)[:3, 3]) < 0.3
        source.correct(frame, truth)
        state, at = true_state(sequence, k, state), k
    assert spreads[3] > spreads[1]


@pytest.mark.parametrize("name", INITIAL)
def test_an_initial_pose_source_does_not_modify_its_input(name: str, setup: Setup, first_frames: list[Frame]):
    source, state = INITIAL_POSE_SOURCES[name](setup), start_of(first_frames)
    step = RelativePose(np.eye(4), np.eye(6) * 1e-4, "test")
    before = [bytes_of(x) for x in (first_frames[1], state, step)]
    source.predict(first_frames[1], state)
    source.correct(first_frames[1], step)
    assert [bytes_of(x) for x in (first_frames[1], state, step)] == before


@pytest.mark.parametrize("name", INITIAL)
def test_an_initial_pose_source_is_deterministic(
    name: str, setup: Setup, sequence: Sequence, first_frames: list[Frame]
):
    def drive() -> list[bytes]:
        source, state, out = INITIAL_POSE_SOURCES[name](setup), start_of(first_frames), []
        for k in range(1, 5):
            out += bytes_of(source.predict(first_frames[k], state))
            source.correct(first_frames[k], true_step(sequence, k - 1, k))
            state = true_state(sequence, k, state)
        return out

    assert drive() == drive()


@pytest.mark.parametrize("name", INITIAL)
def test_an_initial_pose_is_marked_if_it_comes_from_the_imu(name: str, setup: Setup, first_frames: list[Frame]):
    """The graph must not count inertial data twice; without samples a prediction cannot contain any."""
    frame = replace(first_frames[1], imu=ImuSamples.empty())
    assert not INITIAL_POSE_SOURCES[name](setup).predict(frame, start_of(first_frames)).from_imu
