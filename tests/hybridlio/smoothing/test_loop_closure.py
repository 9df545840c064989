from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.errors import DataError
from hybridlio.evaluation.consistency import pose_consistency
from hybridlio.record.loop_keyframes import LoopKeyframes
from hybridlio.smoothing.loop_closure import find_loops, select_consistent
from hybridlio.smoothing.loop_consistency import ConsistencySettings
from hybridlio.smoothing.loops import Loop, LoopSearch
from hybridlio.smoothing.step_uncertainty import OdometryChain


def test_no_loop_is_false(round_trip: Any, closed_round_trip: LoopSearch):
    assert len(closed_round_trip.loops) >= 25
    for loop in closed_round_trip.loops:
        metres, degrees = round_trip.error_of(loop)
        assert metres < 0.2
        assert degrees < 0.5


def test_most_revisits_are_closed_in_both_directions(round_trip: Any, closed_round_trip: LoopSearch):
    ends = {loop.later for loop in closed_round_trip.loops}
    rows = round_trip.record.keyframes.rows
    same_way, other_way = rows[(rows >= 296) & (rows <= 360)], rows[(rows >= 372) & (rows <= 436)]
    assert np.isin(same_way, list(ends)).mean() > 0.6
    assert np.isin(other_way, list(ends)).mean() > 0.7


def test_every_candidate_is_a_loop_or_rejected_with_a_reason(closed_round_trip: LoopSearch):
    search = closed_round_trip
    assert search.candidates == len(search.loops) + len(search.rejected)
    assert search.verified == len(search.loops) + sum(one.stage == "consistency" for one in search.rejected)
    assert all(one.reason and one.stage in ("verification", "consistency") for one in search.rejected)
    assert set(search.seconds) == {"candidates", "verification", "consistency"}


def test_covariances_of_loops_are_consistent(round_trip: Any, closed_round_trip: LoopSearch):
    poses, loops = round_trip.truth.poses, closed_round_trip.loops
    true = np.array([se3.between(poses[loop.earlier], poses[loop.later]) for loop in loops])
    errors = se3.log(se3.between(np.array([loop.pose for loop in loops]), true))
    judged = pose_consistency(errors, np.array([loop.covariance for loop in loops]))
    # half of each error is that of the surroundings, which neighbouring loops share, so covariances are conservative
    assert 0.05 < judged.pose.value < 1.3


def test_an_identical_street_elsewhere_closes_no_loop(round_trip: Any):
    """The second round has the same clouds, but odometry puts it 35 m away with a standard deviation of 1 to 2 m."""
    record = round_trip.record
    poses, first = record.online.poses.copy(), 200
    poses[first:, :3, 3] += np.array([0.0, 35.0, 0.0])
    search = find_loops(replace(record, online=replace(record.online, poses=poses)))
    assert [loop for loop in search.loops if loop.earlier < first <= loop.later] == []


def test_wrong_verified_loops_are_rejected(round_trip: Any, closed_round_trip: LoopSearch):
    chain = OdometryChain(round_trip.record.online, round_trip.record.relative)
    right = list(closed_round_trip.loops)
    wrong = [
        Loop(loop.earlier, loop.later, loop.pose @ se3.exp(np.array([0, 0, 0, 4.0, 0, 0])), loop.covariance, 0.9, 0.2)
        for loop in right[::4]
    ]
    kept, rejected = select_consistent(right + wrong, chain, ConsistencySettings())
    assert {id(loop) for loop in kept}.isdisjoint(id(loop) for loop in wrong)
    assert len(kept) >= 0.9 * len(right)
    assert {(one.earlier, one.later) for one in rejected} >= {(loop.earlier, loop.later) for loop in wrong}
    assert {one.stage for one in rejected} == {"consistency"}


def test_a_single_loop_is_rejected(round_trip: Any, closed_round_trip: LoopSearch):
    chain = OdometryChain(round_trip.record.online, round_trip.record.relative)
    kept, rejected = select_consistent([closed_round_trip.loops[0]], chain, ConsistencySettings())
    assert kept == ()
    assert [one.reason for one in rejected] == ["no other loop nearby agrees"]


def test_a_drive_without_revisits_has_no_candidates(loop_drive: Any):
    search = find_loops(loop_drive(4, [(0, 0), (120, 0)]).record)
    assert (search.candidates, search.verified, search.loops, search.rejected) == (0, 0, (), ())
    assert search.keyframes > 20


def test_progress_is_reported_for_every_keyframe(loop_drive: Any):
    reports: list[tuple[str, int, int]] = []
    record = loop_drive(4, [(0, 0), (30, 0)]).record
    find_loops(record, progress=lambda *what: reports.append(what))
    count = len(record.keyframes)
    assert reports == [("loops", k + 1, count) for k in range(count)]


def test_a_record_without_keyframes_is_an_error_that_says_what_to_do(round_trip: Any):
    with pytest.raises(DataError, match=r"no keyframes.*run the odometry again"):
        find_loops(replace(round_trip.record, keyframes=None))


def test_keyframes_of_another_run_are_an_error(round_trip: Any):
    keyframes = round_trip.record.keyframes
    moved = LoopKeyframes(keyframes.rows, keyframes.stamps_ns + 1, keyframes.clouds)
    late = LoopKeyframes(keyframes.rows + 1000, keyframes.stamps_ns, keyframes.clouds)
    for other in (moved, late):
        with pytest.raises(DataError, match="another run"):
            find_loops(replace(round_trip.record, keyframes=other))
