from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.smoothing.loop_candidates import Candidate, CandidateFinder, CandidateSettings
from hybridlio.smoothing.loop_verification import VerificationSettings
from hybridlio.smoothing.places import KeyframePlaces, levelling_rotations
from hybridlio.smoothing.step_uncertainty import OdometryChain

UP = np.array([0.0, 0.0, 1.0])


def candidates(record: Any, settings: CandidateSettings | None = None) -> list[Candidate]:
    chain, rows = OdometryChain(record.online, record.relative), record.keyframes.rows
    places = KeyframePlaces(record.keyframes, chain, UP, VerificationSettings().reach_m)
    finder = CandidateFinder(chain, rows, places, settings or CandidateSettings())
    return [one for k in range(len(rows)) for one in finder.add(k)]


@pytest.fixture(scope="module")
def found(round_trip: Any) -> list[Candidate]:
    return candidates(round_trip.record)


def true_pose(drive: Any, one: Candidate) -> np.ndarray:
    rows = drive.record.keyframes.rows
    return se3.between(drive.truth.poses[rows[one.earlier]], drive.truth.poses[rows[one.later]])


def test_most_candidates_are_correct_and_have_a_guess_nearby(round_trip: Any, found: list[Candidate]):
    right = 0
    for one in found:
        gaps = [se3.log(se3.between(guess, true_pose(round_trip, one))) for guess in one.guesses]
        right += any(np.linalg.norm(gap[3:]) < 5.0 and np.linalg.norm(gap[:3]) < np.deg2rad(10) for gap in gaps)
    assert right > 0.85 * len(found)


def test_candidates_include_the_opposite_direction_in_the_other_lane(round_trip: Any, found: list[Candidate]):
    headings = [true_pose(round_trip, one)[0, 0] for one in found]
    assert sum(heading < -0.9 for heading in headings) >= 15
    assert sum(heading > 0.9 for heading in headings) >= 10


def test_keyframes_near_along_the_path_are_no_candidates(round_trip: Any, found: list[Candidate]):
    rows = round_trip.record.keyframes.rows
    travelled = OdometryChain(round_trip.record.online, round_trip.record.relative).travelled_m
    assert min(travelled[rows[one.later]] - travelled[rows[one.earlier]] for one in found) >= 40.0
    settings = CandidateSettings(min_path_m=200.0)
    farther = [rows[one.later] - rows[one.earlier] for one in candidates(round_trip.record, settings)]
    assert min(farther) >= 200


def test_a_similar_place_that_odometry_rules_out_is_no_candidate(round_trip: Any):
    record = round_trip.record
    poses = record.online.poses.copy()
    poses[200:, :3, 3] += np.array([0.0, 300.0, 0.0])  # moves the second round to another street
    away = replace(record, online=replace(record.online, poses=poses))
    rows = record.keyframes.rows
    across = [one for one in candidates(away) if rows[one.earlier] < 200 <= rows[one.later]]
    assert across == []


def test_with_uncertain_odometry_descriptors_alone_find_the_place(round_trip: Any):
    uncertain = tuple(replace(step, covariance=1e4 * step.covariance) for step in round_trip.record.relative)
    record = replace(round_trip.record, relative=uncertain)
    rows = record.keyframes.rows
    best = {one.later: one for one in reversed(candidates(record))}  # the first of each keyframe
    again = [one for one in best.values() if rows[one.later] >= 296]
    assert all(len(one.guesses) == 1 for one in again)
    near = [np.linalg.norm(true_pose(round_trip, one)[:3, 3]) < 8.0 for one in again]
    assert len(again) > 20
    assert np.mean(near) > 0.8


def test_a_keyframe_has_at_most_the_requested_number_of_candidates(round_trip: Any, found: list[Candidate]):
    _, counts = np.unique([one.later for one in found], return_counts=True)
    assert counts.max() <= 2
    assert len(candidates(round_trip.record, CandidateSettings(per_keyframe=1))) == len(counts)


def test_levelling_makes_up_the_z_axis(rng: np.random.Generator):
    poses = se3.exp(rng.normal(size=(20, 6)))
    up = rng.normal(size=3)
    turns = levelling_rotations(poses, up)
    in_level = turns[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1) @ (up / np.linalg.norm(up))
    np.testing.assert_allclose(in_level, np.tile([0.0, 0.0, 1.0], (20, 1)), atol=1e-12)
    level = se3.make(se3.so3_exp([0.0, 0.0, 0.7]), np.zeros(3))
    np.testing.assert_allclose(levelling_rotations(level[None], UP)[0], np.eye(4), atol=1e-12)
