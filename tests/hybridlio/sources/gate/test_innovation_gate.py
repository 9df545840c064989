"""The innovation gate: its statistic against χ², its verdicts, and drives with wrong registrations put in."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.estimates import EarlierScanPose, RelativePose
from hybridlio.core.sensors import Frame
from hybridlio.datasets.sequence import Sequence
from hybridlio.odometry.config import Config
from hybridlio.odometry.estimate import Estimate
from hybridlio.odometry.odometry import Odometry
from hybridlio.sources.gate.gate_result import GATE_NIS
from hybridlio.sources.gate.innovation_gate import (
    GROSS_NIS,
    MAX_REJECTIONS,
    WARM_UP_STEPS,
    InnovationGate,
    inflation_to_gate,
    normalised_innovation_squared,
)
from hybridlio.sources.scan_matching import ScanMatching

STEP = se3.exp(np.array([0.01, -0.02, 0.05, 1.0, 0.1, -0.02]))
COVARIANCE = np.diag(np.r_[np.full(3, 1e-3), np.full(3, 0.01)] ** 2)
DT_S = 0.1
IMU = RelativePose(STEP, COVARIANCE, "preintegration", from_imu=True)


def off_by(sigmas: float, axis: int = 3, **changes: object) -> RelativePose:
    """A step that differs from the IMU's by ``sigmas`` standard deviations of the difference."""
    xi = np.zeros(6)
    xi[axis] = sigmas * np.sqrt(2 * COVARIANCE[axis, axis])
    return replace(RelativePose(STEP @ se3.exp(xi), COVARIANCE, "test"), **changes)


def started() -> InnovationGate:
    gate = InnovationGate()
    far = replace(IMU, pose=off_by(100).pose)
    for _ in range(WARM_UP_STEPS):
        assert gate.apply(off_by(0.0), far, far, DT_S)[1].verdict == "untested"
    return gate


def test_one_right_measurement_in_ten_thousand_is_outside_the_gate():
    from scipy.stats import chi2

    assert chi2.sf(GATE_NIS, 6) == pytest.approx(1e-4, rel=0.01)


def test_the_normalised_innovation_squared_of_right_covariances_is_chi_square_distributed(rng: np.random.Generator):
    roots = np.linalg.cholesky(COVARIANCE)
    measured = [RelativePose(STEP @ se3.exp(roots @ rng.normal(size=6)), COVARIANCE, "test") for _ in range(2000)]
    predicted = [RelativePose(STEP @ se3.exp(roots @ rng.normal(size=6)), COVARIANCE, "imu") for _ in range(2000)]
    values = [normalised_innovation_squared(m, p) for m, p in zip(measured, predicted, strict=True)]
    assert np.mean(values) == pytest.approx(6.0, abs=0.3)
    assert np.mean(np.array(values) > 16.81) == pytest.approx(0.01, abs=0.007)


@pytest.mark.parametrize(("sigmas", "axis"), [(7.0, 3), (12.0, 3), (9.0, 0)])
def test_an_inflated_covariance_puts_the_innovation_at_the_gate(sigmas: float, axis: int):
    measured = off_by(sigmas, axis)
    times = inflation_to_gate(measured, IMU)
    assert times > 1
    assert normalised_innovation_squared(measured.wider(times), IMU) == pytest.approx(GATE_NIS, rel=1e-6)


def test_a_covariance_within_the_gate_is_not_inflated():
    assert inflation_to_gate(off_by(1.0), IMU) == 1.0


def test_a_step_is_accepted_down_weighted_or_rejected_by_its_innovation():
    gate = started()
    taken, result = gate.apply(measured := off_by(3.0), IMU, IMU, DT_S)
    assert (taken, result.verdict) == (measured, "accepted")
    earlier = EarlierScanPose(7, STEP, COVARIANCE)
    far = off_by(14.0, drift=0.1 * COVARIANCE, earlier_scans=(earlier,))
    taken, result = gate.apply(far, IMU, IMU, DT_S)
    assert result.verdict == "down-weighted"
    assert result.nis == pytest.approx(196.0)
    times = inflation_to_gate(far, IMU)
    for mine, theirs in (
        (taken.covariance, far.covariance),
        (taken.earlier_scans[0].covariance, COVARIANCE),
    ):
        np.testing.assert_allclose(mine, times * theirs)
    np.testing.assert_array_equal(taken.drift, far.drift)  # the next scan finds the map where it was
    np.testing.assert_allclose(taken.pose, far.pose, atol=1e-12)
    taken, result = gate.apply(off_by(20.0, earlier_scans=(earlier,)), IMU, IMU, DT_S)
    assert result.verdict == "rejected"
    assert (taken.ok, taken.source, taken.earlier_scans, taken.drift) == (False, "preintegration", (), None)
    assert taken.details["nis"] > GROSS_NIS


@pytest.mark.parametrize(
    ("measured", "predicted"),
    [
        (off_by(100), None),
        (off_by(100), replace(IMU, ok=False)),
        (off_by(100), replace(IMU, covariance=np.diag(np.r_[np.full(3, 1e-3), np.full(3, 2.0)] ** 2))),
        (off_by(100, ok=False), IMU),
        (off_by(100, from_imu=True), IMU),
    ],
    ids=["no IMU", "IMU gap", "unknown speed", "failed scan", "the IMU itself"],
)
def test_nothing_is_tested_without_a_prediction_and_a_measurement(
    measured: RelativePose, predicted: RelativePose | None
):
    taken, result = started().apply(measured, predicted, IMU, DT_S)
    assert taken is measured
    assert result.verdict == "untested"
    assert result.nis is None


def at_the_limit_of_rejections() -> InnovationGate:
    gate = started()
    verdicts = [gate.apply(off_by(50), IMU, IMU, DT_S)[1].verdict for _ in range(MAX_REJECTIONS)]
    assert verdicts == ["rejected"] * MAX_REJECTIONS
    return gate


def test_after_a_few_rejections_the_map_is_relocated_and_the_jump_left_out_of_the_path():
    gate = at_the_limit_of_rejections()
    taken, result = gate.apply(off_by(50), IMU, IMU, DT_S)
    assert result.verdict == "relocated"
    assert (taken.ok, taken.source) == (False, "preintegration")
    np.testing.assert_array_equal(taken.pose, STEP)
    assert gate.apply(off_by(0.5), IMU, IMU, DT_S)[1].verdict == "accepted"
    assert gate.apply(off_by(50), IMU, IMU, DT_S)[1].verdict == "rejected"


def test_scans_that_jump_again_and_again_end_with_the_imu_left_out():
    gate = at_the_limit_of_rejections()
    verdicts = [gate.apply(off_by(50), IMU, IMU, DT_S)[1].verdict for _ in range(4)]
    assert verdicts == ["relocated"] + ["IMU left out"] * 3
    assert gate.apply(off_by(0.5), IMU, IMU, DT_S)[1].verdict == "accepted"
    assert gate.apply(off_by(50), IMU, IMU, DT_S)[1].verdict == "rejected"


def wrong_imu(by_rad: float) -> RelativePose:
    return replace(IMU, pose=STEP @ se3.exp([0, 0, by_rad, 0, 0, 0]))


def test_an_imu_that_contradicts_two_smooth_steps_is_left_out():
    gate, imu = started(), wrong_imu(0.03)
    gate.apply(RelativePose(STEP, COVARIANCE, "test"), IMU, IMU, DT_S)
    drift = 0.1 * COVARIANCE
    first, undecided = gate.apply(RelativePose(STEP, COVARIANCE, "test", drift=drift), imu, imu, DT_S)
    assert (undecided.verdict, undecided.uses_imu, undecided.takes_back) == ("undecided", False, True)
    assert (first.ok, first.source) == (False, "preintegration")
    np.testing.assert_array_equal(first.drift, drift)  # the path goes on through the map
    assert np.sqrt(first.covariance[2, 2]) > 0.02  # spans both
    corrected = RelativePose(se3.between(imu.pose, STEP) @ STEP, COVARIANCE, "test")  # from the bridge to the next scan
    taken, result = gate.apply(corrected, imu, imu, DT_S)
    assert (result.verdict, result.uses_imu, taken) == ("IMU left out", False, corrected)


def test_small_contradictions_never_put_the_imu_out():
    gate = started()
    gate.apply(RelativePose(STEP, COVARIANCE, "test"), IMU, IMU, DT_S)
    verdicts = [gate.apply(off_by(7.0), IMU, IMU, DT_S)[1].verdict for _ in range(30)]
    assert verdicts == ["down-weighted"] * 30


def test_scans_that_leave_a_direction_unconstrained_never_put_the_imu_out():
    gate, imu = started(), wrong_imu(0.03)
    ahead = np.array([[0.0, 0, 0, 1, 0, 0]])
    for _ in range(3):
        scan = RelativePose(STEP, COVARIANCE, "test", degenerate=ahead)
        assert gate.apply(scan, imu, imu, DT_S)[1].verdict in ("rejected", "down-weighted")


def test_an_imu_that_is_left_out_is_still_compared():
    gate = started()
    taken, result = gate.apply(measured := off_by(20.0), IMU, IMU, DT_S, leaves_out_imu=True)
    assert (taken, result.verdict) == (measured, "IMU left out")
    assert result.nis == pytest.approx(400.0)
    assert gate.apply(measured, None, IMU, DT_S, leaves_out_imu=True)[1].nis is None


# ---------------------------------------------------------------------------------------------------- in a drive


class Slipping(ScanMatching):
    """Scan matching that reports a wrong pose with a small covariance at some scans."""

    def __init__(self, wrong: range, by_m: float) -> None:
        super().__init__()
        self._wrong, self._by_m = wrong, by_m

    def refine(self, frame: Frame, initial: RelativePose) -> RelativePose:
        found = super().refine(frame, initial)
        if frame.index not in self._wrong:
            return found
        slipped = se3.exp(np.array([0, 0, 0, self._by_m, 0, 0]))
        current = self._state.current
        self._state = replace(self._state, current=replace(current, T_map_lidar=current.T_map_lidar @ slipped))
        return replace(found, pose=found.pose @ slipped)


def driven(sequence: Sequence, source: ScanMatching) -> list[Estimate]:
    odometry = Odometry(residual=source, config=Config())
    return [odometry.step(frame) for frame in sequence]


def farthest_off(estimates: list[Estimate], sequence: Sequence) -> float:
    assert sequence.reference is not None
    poses = np.array([e.pose for e in estimates])
    return float(np.linalg.norm(poses[:, :3, 3] - sequence.reference.poses[:, :3, 3], axis=1).max())


def test_a_wrong_registration_is_rejected_and_leaves_the_path_unharmed(sequence: Sequence):
    clean, slipped = driven(sequence, ScanMatching()), driven(sequence, Slipping(range(15, 17), 2.0))
    assert {e.gate.verdict for e in clean[WARM_UP_STEPS + 1 :]} <= {"accepted", "down-weighted"}
    rejected = [e.index for e in slipped if e.gate.verdict == "rejected"]
    assert rejected == [15, 16]
    assert [e.index for e in slipped[1:] if e.relative and not e.relative.ok] == rejected
    assert farthest_off(slipped, sequence) < farthest_off(clean, sequence) + 0.05


def test_a_lost_map_is_relocated_without_a_jump_in_the_path(sequence: Sequence):
    """The registration slips at every scan until its own path is allowed to keep the jump."""
    clean, slipped = (
        driven(sequence, ScanMatching()),
        driven(sequence, Slipping(range(12, 13 + MAX_REJECTIONS), 1.0)),
    )
    verdicts = [e.gate.verdict for e in slipped[12 : 14 + MAX_REJECTIONS]]
    assert verdicts == ["rejected"] * MAX_REJECTIONS + ["relocated", "accepted"]
    bridged_m = 0.2  # six steps by an IMU that started a second ago
    assert farthest_off(slipped, sequence) < farthest_off(clean, sequence) + bridged_m


def test_the_imu_gates_steps_with_any_initial_pose_source(sequence: Sequence):
    odometry = Odometry(initial_pose="constant-velocity", residual=Slipping(range(15, 16), 2.0))
    estimates = [odometry.step(sequence[k]) for k in range(18)]
    assert [e.index for e in estimates if e.gate.verdict == "rejected"] == [15]
