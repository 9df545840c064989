from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.errors import DataError
from hybridlio.evaluation.consistency import pose_consistency
from hybridlio.record.loop_keyframes import LoopKeyframes
from hybridlio.smoothing.loop_closure import consistent, find_loops
from hybridlio.smoothing.loop_consistency import ConsistencySettings
from hybridlio.smoothing.loops import Loop, LoopSearch
from hybridlio.smoothing.step_uncertainty import OdometryChain


def test_no_loop_is_false(round_trip: Any, closed_round_trip: LoopSearch):
    assert len(closed_round_trip.loops) >= 25
    for loop in closed_round_trip.loops:
        metres, degrees = round_trip.error_of(loop)
        assert metres < 0.2
        assert degrees < 0.5


def test_most_revisits_are_closed_either_way(round_trip: Any, closed_round_trip: LoopSearch):
    ends = {loop.later for loop in closed_round_trip.loops}
    rows = round_trip.record.keyframes.rows
    same_way, other_way = rows[(rows >= 296) & (rows <= 360)], rows[(rows >= 372) & (rows <= 436)]
    assert np.isin(same_way, list(ends)).mean() > 0.6
    assert np.isin(other_way, list(ends)).mean() > 0.7


def test_every_candidate_is_a_loop_or_has_a_reason_why_not(closed_round_trip: LoopSearch):
    search = closed_round_trip
    assert search.candidates == len(search.loops) + len(search.rejected)
    assert search.verified == len(search.loops) + sum(one.stage == "consistency" for one in search.rejected)
    assert all(one.reason and one.stage in ("verification", "consistency") for one in search.rejected)
    assert set(search.seconds) == {"candidates", "verification", "consistency"}


def test_loops_are_as_far_off_as_their_covariances_say(round_trip: Any, closed_round_trip: LoopSearch):
    poses, loops = round_trip.truth.poses, closed_round_trip.loops
    true = np.array([se3.between(poses[loop.earlier], poses[loop.later]) for loop in loops])
    errors = se3.log(se3.between(np.array([loop.pose for loop in loops]), true))
    judged = pose_consistency(errors, np.array([loop.covariance for loop in loops]))
    # each half of the error is the surroundings', which neighbouring loops share: less sure than one by one is right
    assert 0.05 < judged.pose.value < 1.3


def test_a_street_that_looks_the_same_elsewhere_closes_no_loop(round_trip: Any):
    """The second round's clouds, at a place that odometry has 35 m from the first and knows to a metre or two."""
    record = round_trip.record
    poses, first = record.online.poses.copy(), 200
    poses[first:, :3, 3] += np.array([0.0, 35.0, 0.0])
    search = find_loops(replace(record, online=replace(record.online, poses=poses)))
    assert [loop for loop in search.loops if loop.earlier < first <= loop.later] == []


def test_wrong_loops_among_those_verified_are_found(round_trip: Any, closed_round_trip: LoopSearch):
    chain = OdometryChain(round_trip.record.online, round_trip.record.relative)
    right = list(closed_round_trip.loops)
    wrong = [
        Loop(loop.earlier, loop.later, loop.pose @ se3.exp(np.array([0, 0, 0, 4.0, 0, 0])), loop.covariance, 0.9, 0.2)
        for loop in right[::4]
    ]
    kept, rejected = consistent(right + wrong, chain, ConsistencySettings())
    assert {id(loop) for loop in kept}.isdisjoint(id(loop) for loop in wrong)
    assert len(kept) >= 0.9 * len(right)
    assert {(one.earlier, one.later) for one in rejected} >= {(loop.earlier, loop.later) for loop in wrong}
    assert {one.stage for one in rejected} == {"consistency"}


def test_a_single_loop_is_not_believed(round_trip: Any, closed_round_trip: LoopSearch):
    chain = OdometryChain(round_trip.record.online, round_trip.record.relative)
    kept, rejected = consistent([closed_round_trip.loops[0]], chain, ConsistencySettings())
    assert kept == ()
    assert [one.reason for one in rejected] == ["no other loop nearby agrees"]


def test_without_any_candidate_there_is_nothing_to_reject(loop_drive: Any):
    search = find_loops(loop_drive(4, [(0, 0), (120, 0)]).record)
    assert (search.candidates, search.verified, search.loops, search.rejected) == (0, 0, (), ())
    assert search.keyframes > 20


def test_progress_is_told_of_every_keyframe(loop_drive: Any):
    told: list[tuple[str, int, int]] = []
    record = loop_drive(4, [(0, 0), (30, 0)]).record
    find_loops(record, progress=lambda *what: told.append(what))
    count = len(record.keyframes)
    assert told == [("loops", k + 1, count) for k in range(count)]


def test_a_record_without_keyframes_is_told_what_to_do(round_trip: Any):
    with pytest.raises(DataError, match=r"no keyframes.*run the odometry again"):
        find_loops(replace(round_trip.record, keyframes=None))


def test_keyframes_of_another_run_are_refused(round_trip: Any):
    keyframes = round_trip.record.keyframes
    moved = LoopKeyframes(keyframes.rows, keyframes.stamps_ns + 1, keyframes.clouds)
    late = LoopKeyframes(keyframes.rows + 1000, keyframes.stamps_ns, keyframes.clouds)
    for other in (moved, late):
        with pytest.raises(DataError, match="another run"):
            find_loops(replace(round_trip.record, keyframes=other))
