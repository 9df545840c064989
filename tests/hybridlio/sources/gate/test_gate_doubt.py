"""Scans that move abruptly against the IMU make the path doubtful that the IMU has not confirmed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hybridlio.core import se3
from hybridlio.core.estimates import RelativePose
from hybridlio.sources.gate.innovation_gate import MAX_REJECTIONS, WARM_UP_STEPS, InnovationGate

DT_S = 0.1
COVARIANCE = np.diag(np.r_[np.full(3, 1e-3), np.full(3, 0.01)] ** 2)


def step_of(length_m: float, from_imu: bool = False, matched: float = 0.9) -> RelativePose:
    pose = se3.exp(np.array([0.0, 0.0, 0.0, length_m, 0.0, 0.0]))
    details = {} if from_imu else {"matched": matched}
    return RelativePose(pose, COVARIANCE, "imu" if from_imu else "scans", from_imu=from_imu, details=details)


def gate_after(steps: int) -> InnovationGate:
    """Return a gate after some steps of a metre in which scans and IMU agree."""
    gate = InnovationGate()
    for _ in range(steps):
        gate.apply(step_of(1.0), step_of(1.0, True), step_of(1.0, True), DT_S)
    return gate


def contradicted(gate: InnovationGate, found_m: float, left_out: bool = False, matched: float = 0.9) -> None:
    gate.apply(step_of(found_m, matched=matched), step_of(1.0, True), step_of(1.0, True), DT_S, left_out)


def failed(gate: InnovationGate, **details: float) -> None:
    """Take a scan that the IMU bridges, because it could not be matched."""
    bridge = step_of(1.0, True)
    gate.apply(replace(bridge, ok=False, details=details), bridge, bridge, DT_S)


def test_a_start_that_changes_its_speed_against_the_imu_may_be_wrong_by_its_length() -> None:
    gate = gate_after(3)
    contradicted(gate, 3.0)
    assert gate.doubt.m2 == (3 * 1.0 + 3.0) ** 2


def test_the_same_path_is_doubted_once() -> None:
    gate = gate_after(3)
    contradicted(gate, 3.0)
    doubt_m2 = gate.doubt.m2
    contradicted(gate, 1.0)  # back to the IMU's step
    assert gate.doubt.m2 == doubt_m2


def test_a_path_that_the_imu_has_confirmed_is_not_doubted() -> None:
    gate = gate_after(2 * WARM_UP_STEPS + 1)
    contradicted(gate, 3.0, left_out=True)
    assert gate.doubt.m2 == 3.0**2


def test_scans_that_move_on_smoothly_are_not_doubted_whatever_the_imu_says() -> None:
    gate = InnovationGate()
    for _ in range(3 * WARM_UP_STEPS):
        gate.apply(step_of(1.0), step_of(3.0, True), step_of(3.0, True), DT_S, leaves_out_imu=True)
    assert gate.doubt.m2 == 0


def test_without_a_prediction_nothing_is_doubted() -> None:
    gate = gate_after(3)
    gate.apply(step_of(3.0), None, step_of(1.0), DT_S)
    assert gate.doubt.m2 == 0


def test_a_scan_that_does_not_fit_the_map_is_doubted_until_the_next_one_fits() -> None:
    gate = gate_after(2 * WARM_UP_STEPS + 1)
    contradicted(gate, 5.0, matched=0.4)
    assert gate.doubt.m2 == 5.0**2
    contradicted(gate, 1.0)
    assert gate.doubt.m2 == 0


def test_a_jump_to_another_place_stays_doubted_and_grows_until_the_imu_agrees_for_a_while() -> None:
    gate = gate_after(2 * WARM_UP_STEPS + 1)
    doubts = []
    for _ in range(2 * MAX_REJECTIONS + 2):
        contradicted(gate, 5.0, matched=0.4)
        doubts.append(gate.doubt.m2)
    assert all(np.diff(doubts) > 0)
    for _ in range(2 * WARM_UP_STEPS):
        contradicted(gate, 1.0)
    stays = gate.doubt.m2
    contradicted(gate, 5.0, left_out=True)
    assert gate.doubt.m2 >= stays >= doubts[-1] / 2
    for _ in range(2 * WARM_UP_STEPS):
        contradicted(gate, 1.0)
    assert gate.doubt.m2 <= stays + 5.0**2


def test_a_place_where_scans_still_fit_poorly_is_not_the_old_one_though_the_imu_agrees() -> None:
    gate = gate_after(2 * WARM_UP_STEPS + 1)
    contradicted(gate, 5.0, matched=0.4)
    contradicted(gate, 1.0, matched=0.4)  # 2 m from where the scans last agreed, 3 m back from where one was found
    assert gate.doubt.m2 == (5.0 + 3.0) ** 2
    for _ in range(2 * WARM_UP_STEPS):
        contradicted(gate, 1.0)
    assert gate.doubt.m2 == (5.0 + 3.0) ** 2


def test_scans_that_match_nowhere_are_doubted_until_one_fits_and_for_good_where_a_new_map_begins() -> None:
    gate = gate_after(2 * WARM_UP_STEPS + 1)
    failed(gate, matched=0.3)
    failed(gate, matched=0.3)
    assert gate.doubt.m2 == 2.0**2
    contradicted(gate, 1.0)
    assert gate.doubt.m2 == 0
    for _ in range(WARM_UP_STEPS):
        contradicted(gate, 1.0)
    failed(gate, matched=0.3)
    failed(gate, matched=0.3, new_map=1.0)
    contradicted(gate, 1.0)
    assert gate.doubt.m2 == 2.0**2
    assert gate.doubt.lasting_m == 2.0


def test_empty_scans_that_the_imu_bridges_are_not_doubted() -> None:
    gate = gate_after(2 * WARM_UP_STEPS + 1)
    for _ in range(5):
        failed(gate)
    assert gate.doubt.m2 == 0


def test_a_contradiction_by_scans_that_fit_as_usual_is_no_jump() -> None:
    gate = gate_after(2 * WARM_UP_STEPS + 1)
    contradicted(gate, 5.0, matched=0.85)
    assert gate.doubt.m2 == 0


def test_a_contradiction_is_doubted_once_scans_after_it_fit_poorly_until_the_imu_has_confirmed_the_path() -> None:
    gate = gate_after(2 * WARM_UP_STEPS + 1)
    contradicted(gate, 5.0, matched=0.85)
    contradicted(gate, 1.0, matched=0.4)
    assert gate.doubt.m2 == (5.0 + 3.0) ** 2
    gate = gate_after(2 * WARM_UP_STEPS + 1)
    contradicted(gate, 5.0, matched=0.85)
    for _ in range(2 * WARM_UP_STEPS):
        contradicted(gate, 1.0)
    contradicted(gate, 1.0, matched=0.4)
    assert gate.doubt.m2 == 0
