"""Transitions of scan matching's state."""

from __future__ import annotations

from dataclasses import FrozenInstanceError

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.estimates import RelativePose
from hybridlio.sources.matching_state import MatchingState

POINTS = np.zeros((3, 3))
TWIST = np.array([0.0, 0.0, 0.1, 5.0, 0.0, 0.0])
STEP = se3.exp(0.1 * TWIST)
NOTHING, ALONG = np.empty((0, 6)), np.eye(6)[3:4]  # directions that a scan leaves unobserved
INITIAL = RelativePose(se3.exp([0.0, 0.0, 0.0, 0.4, 0.0, 0.0]), 1e-2 * np.eye(6), "imu")


@pytest.fixture
def started() -> MatchingState:
    return MatchingState.started(POINTS)


@pytest.fixture
def matched(started: MatchingState) -> MatchingState:
    return started.keyframe_inserted().matched(STEP, 0.1, NOTHING, adrift=0)


def test_the_first_scan_is_the_origin_and_a_pending_keyframe(started: MatchingState):
    np.testing.assert_array_equal(started.current.T_map_lidar, np.eye(4))
    assert started.keyframe is POINTS
    assert started.current.map_changed
    assert started.keyframe_inserted().keyframe is None


def test_a_state_is_immutable(started: MatchingState):
    with pytest.raises(FrozenInstanceError):
        started.adrift = 1  # type: ignore[misc]


def test_a_match_moves_on_and_measures_the_twist(started: MatchingState, matched: MatchingState):
    np.testing.assert_array_equal(matched.current.T_map_lidar, STEP)
    np.testing.assert_allclose(matched.current.twist, TWIST, atol=1e-12)
    assert matched.previous is started.current
    assert not matched.current.map_changed
    assert (matched.doubted, matched.keyframe, matched.adrift) == (None, None, 0)


@pytest.mark.parametrize("unobserved", [NOTHING, ALONG])
@pytest.mark.parametrize("is_vague", [False, True])
def test_a_scan_is_adrift_only_if_it_is_degenerate_and_starts_at_a_vague_pose(
    started: MatchingState, unobserved: np.ndarray, is_vague: bool
):
    assert started.is_adrift_with(unobserved, is_vague) == (len(unobserved) > 0 and is_vague)


def test_only_a_degenerate_match_leaves_the_twist_unknown(started: MatchingState):
    assert started.matched(STEP, 0.1, ALONG, adrift=0).current.twist is None
    assert started.matched(STEP, 0.1, NOTHING, adrift=0).current.twist is not None


def test_four_scans_after_those_adrift_are_doubted_too_and_the_fifth_is_not(started: MatchingState):
    """By chance single scans seem to observe what others do not."""
    state = started.matched(STEP, 0.1, ALONG, adrift=1)
    assert not state.is_adrift_with(NOTHING, is_vague=False)
    for count in (2, 3, 4, 5):
        assert state.is_adrift_with(NOTHING, is_vague=True)
        state = state.matched(STEP, 0.1, NOTHING, adrift=count)
        np.testing.assert_array_equal(state.unobserved, ALONG)
    assert not state.is_adrift_with(NOTHING, is_vague=True)
    assert state.matched(STEP, 0.1, ALONG, adrift=6).is_adrift_with(NOTHING, is_vague=True)


def test_what_a_scan_with_a_known_start_leaves_unobserved_is_not_remembered(started: MatchingState):
    known = started.matched(STEP, 0.1, ALONG, adrift=0)
    assert not known.is_adrift_with(NOTHING, is_vague=True)


def test_a_pending_keyframe_changes_the_map_before_the_next_match(matched: MatchingState):
    pending = matched.keyframe_pending(POINTS)
    assert pending.keyframe is POINTS
    assert pending.current.map_changed
    assert not pending.matched(STEP @ STEP, 0.1, NOTHING, adrift=0).current.map_changed


def test_bridges_add_up_until_the_next_match(matched: MatchingState):
    once = matched.keyframe_pending(POINTS).keyframe_inserted().bridged(INITIAL)
    twice = once.bridged(INITIAL)
    np.testing.assert_allclose(twice.current.T_map_lidar, STEP @ INITIAL.pose @ INITIAL.pose)
    np.testing.assert_array_equal(once.current.bridge_covariance, INITIAL.covariance)
    assert (np.diag(twice.current.bridge_covariance) >= 2 * np.diag(INITIAL.covariance) - 1e-15).all()
    assert twice.current.bridged
    assert twice.current.map_changed  # the keyframe before the first bridge still counts for the next match
    found = twice.matched(twice.current.T_map_lidar, 0.1, NOTHING, adrift=0).current
    assert found.twist is None  # the motion since a bridge is not measured
    np.testing.assert_array_equal(found.bridge_covariance, np.zeros((6, 6)))


def test_while_the_map_is_empty_a_bridged_scan_becomes_its_first_keyframe(started: MatchingState):
    assert started.keyframe_inserted().bridged(INITIAL, POINTS).keyframe is POINTS


def test_a_match_taken_back_is_replaced_by_the_initial_pose_but_remembered(matched: MatchingState):
    state = matched.keyframe_pending(POINTS).taken_back(INITIAL)
    np.testing.assert_array_equal(state.current.T_map_lidar, INITIAL.pose)
    assert state.current.bridged
    assert state.keyframe is None
    assert state.doubted is not None
    np.testing.assert_array_equal(state.last_found.T_map_lidar, STEP)
    again = state.matched(STEP @ STEP, 0.1, NOTHING, adrift=0)
    np.testing.assert_allclose(again.current.twist, TWIST, atol=1e-12)  # from where the scan was found
    assert again.doubted is None


def test_a_new_map_starts_where_the_bridges_led_without_their_error(matched: MatchingState):
    """The error of the bridges belongs to the step to the new map, and not to the steps within it."""
    keyframe = np.ones((7, 3))
    lost = matched.bridged(RelativePose(np.eye(4), np.eye(6), "guess"))
    restarted = lost.restarted(keyframe)
    np.testing.assert_array_equal(restarted.current.T_map_lidar, lost.current.T_map_lidar)
    assert restarted.keyframe is keyframe
    assert restarted.adrift
    assert restarted.current.map_changed
    assert not restarted.current.bridge_covariance.any()


def test_a_state_placed_by_two_poses_moves_on_by_their_twist():
    state = MatchingState.placed(np.eye(4), STEP, 0.1, POINTS)
    assert state.current.twist is not None
    np.testing.assert_allclose(state.current.twist, TWIST, atol=1e-12)
    np.testing.assert_array_equal(state.current.T_map_lidar, STEP)
    assert state.current.map_changed
    assert state.keyframe is POINTS


def test_independent_steps_with_what_bridges_add_sum_up_to_errors_that_are_all_one(matched: MatchingState):
    """Ten steps at a velocity whose error lasts are off by ten times that of one; independent ones by √10 of it."""
    straight = RelativePose(se3.exp([0.0, 0.0, 0.0, 0.4, 0.0, 0.0]), np.diag([1e-12] * 3 + [1e-2] * 3), "velocity")
    chained, point, bridge = np.zeros((6, 6)), matched.current, matched
    for _ in range(10):
        bridge = bridge.bridged(straight)
        added = bridge.current.added_since(point, straight)
        assert np.linalg.eigvalsh(added).min() > 0
        chained = se3.compose_covariance(chained, straight.pose, added)
        point = bridge.current
    np.testing.assert_allclose(chained, point.bridge_covariance, atol=1e-12)
    np.testing.assert_allclose(np.sqrt(np.diag(chained)[3:]), 10 * 0.1, rtol=1e-3)
