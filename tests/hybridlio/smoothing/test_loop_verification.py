from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.record.loop_keyframes import RESOLUTION_M, LoopKeyframes
from hybridlio.smoothing.loop_verification import PreparedPlaces, VerificationSettings, Verifier
from hybridlio.smoothing.places import KeyframePlaces
from hybridlio.smoothing.step_uncertainty import OdometryChain


def verifier_of(keyframes: LoopKeyframes, chain: OdometryChain) -> Verifier:
    places = KeyframePlaces(keyframes, chain, np.array([0.0, 0.0, 1.0]), VerificationSettings().reach_m)
    prepared = PreparedPlaces(places, VerificationSettings())
    return Verifier(prepared, prepared, VerificationSettings())


@pytest.fixture(scope="module")
def verifier(round_trip: Any) -> Verifier:
    record = round_trip.record
    return verifier_of(record.keyframes, OdometryChain(record.online, record.relative))


def keyframe_at(drive: Any, row: int) -> int:
    return int(np.searchsorted(drive.record.keyframes.rows, row))


def true_pose(drive: Any, earlier: int, later: int) -> np.ndarray:
    rows = drive.record.keyframes.rows
    return se3.between(drive.truth.poses[rows[earlier]], drive.truth.poses[rows[later]])


@pytest.mark.parametrize(("earlier", "later"), [(24, 316), (40, 400)], ids=["same way", "other way, other lane"])
def test_a_revisit_is_verified_from_starts_metres_and_degrees_away(
    round_trip: Any, verifier: Verifier, earlier: int, later: int
):
    earlier, later = keyframe_at(round_trip, earlier), keyframe_at(round_trip, later)
    true = true_pose(round_trip, earlier, later)
    for off in ([0, 0, 0.05, 2.5, -1.5, 0.2], [0.01, 0.01, -0.05, -2.5, 1.5, -0.2]):
        verdict = verifier.verify(earlier, later, [true @ se3.exp(np.array(off))])
        assert verdict.reason == ""
        wrong = se3.log(se3.between(verdict.pose, true))
        assert np.linalg.norm(wrong[3:]) < 0.1
        assert np.linalg.norm(wrong[:3]) < np.deg2rad(0.3)
        assert wrong @ np.linalg.solve(verdict.covariance, wrong) < 22.5  # 99.9 % of χ² of six degrees of freedom


def test_another_place_is_rejected_with_the_reason(round_trip: Any, verifier: Verifier):
    earlier, later = keyframe_at(round_trip, 40), keyframe_at(round_trip, 200)
    for yaw in (0.0, np.pi / 2, np.pi):
        verdict = verifier.verify(earlier, later, [se3.make(se3.so3_exp([0.0, 0.0, yaw]), np.zeros(3))])
        assert "match" in verdict.reason or "fit" in verdict.reason


def test_a_start_too_far_away_is_rejected(round_trip: Any, verifier: Verifier):
    earlier, later = keyframe_at(round_trip, 24), keyframe_at(round_trip, 316)
    true = true_pose(round_trip, earlier, later)
    for metres in (15.0, -15.0, 25.0):
        verdict = verifier.verify(earlier, later, [true @ se3.exp(np.array([0, 0, 0, metres, 0, 0]))])
        assert "of the points match" in verdict.reason


def test_bare_ground_is_rejected(round_trip: Any, rng: np.random.Generator):
    rows, stamps = round_trip.record.keyframes.rows, round_trip.record.keyframes.stamps_ns
    flat = np.column_stack([rng.uniform(-40, 40, (4000, 2)), rng.normal(-1.8, 0.01, 4000)])
    clouds = tuple(np.round(flat / RESOLUTION_M).astype(np.int16) for _ in rows)
    chain = OdometryChain(round_trip.record.online, round_trip.record.relative)
    verdict = verifier_of(LoopKeyframes(rows, stamps, clouds), chain).verify(3, 70, [np.eye(4)])
    assert verdict.reason == "too few points above the ground"


def test_a_single_wall_is_rejected_as_degenerate(round_trip: Any, rng: np.random.Generator):
    rows, stamps = round_trip.record.keyframes.rows, round_trip.record.keyframes.stamps_ns
    straight = replace(round_trip.record.online, poses=se3.make(np.eye(3), np.arange(440.0)[:, None] * [1, 0, 0]))
    flat = np.column_stack([rng.uniform(-40, 40, (2500, 2)), np.full(2500, -1.8)])
    wall = np.column_stack([rng.uniform(-40, 40, 2500), np.full(2500, 6.0), rng.uniform(-1.8, 4, 2500)])
    cloud = np.concatenate([flat, wall]) + rng.normal(0.0, 0.01, (5000, 3))
    clouds = tuple(np.round(cloud / RESOLUTION_M).astype(np.int16) for _ in rows)
    chain = OdometryChain(straight, round_trip.record.relative)
    verdict = verifier_of(LoopKeyframes(rows, stamps, clouds), chain).verify(3, 70, [np.eye(4)])
    assert verdict.reason == "a direction is not constrained"


def test_the_surroundings_are_the_merged_neighbours(round_trip: Any):
    k = keyframe_at(round_trip, 40)
    record, keyframes = round_trip.record, round_trip.record.keyframes
    chain = OdometryChain(record.online, record.relative)
    own = keyframes.points(k)
    around = KeyframePlaces(keyframes, chain, np.array([0.0, 0.0, 1.0]), reach_m=10.0).surroundings(k)
    assert len(around) == sum(len(keyframes.clouds[j]) for j in (k - 2, k - 1, k, k + 1, k + 2))
    nearest = np.linalg.norm(around[:, None, :] - own[None, ::500], axis=-1).min(axis=0)
    np.testing.assert_allclose(nearest, 0.0, atol=1e-9)
