"""The comparison of relative poses with the IMU, against χ² and with wrong poses put in on purpose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.estimates import KeyframePose, RelativePose
from hybridlio.core.sensors import Frame
from hybridlio.datasets.sequence import Sequence
from hybridlio.odometry.config import Config
from hybridlio.odometry.odometry import Estimate, Odometry
from hybridlio.sources.innovation_gate import GATE, GROSS, MOST_REJECTED, START_STEPS, Witness, chi2_of, widening
from hybridlio.sources.scan_matching import ScanMatching

STEP = se3.exp(np.array([0.01, -0.02, 0.05, 1.0, 0.1, -0.02]))
COVARIANCE = np.diag(np.r_[np.full(3, 1e-3), np.full(3, 0.01)] ** 2)
IMU = RelativePose(STEP, COVARIANCE, "preintegration", from_imu=True)


def off_by(sigmas: float, axis: int = 3, **changes: object) -> RelativePose:
    """A step that differs from the IMU's by so many standard deviations of the difference."""
    xi = np.zeros(6)
    xi[axis] = sigmas * np.sqrt(2 * COVARIANCE[axis, axis])
    return replace(RelativePose(STEP @ se3.exp(xi), COVARIANCE, "test"), **changes)


def started() -> Witness:
    witness = Witness()
    for _ in range(START_STEPS):
        assert witness.judge(off_by(100), IMU, IMU)[1].verdict == "untested"
    return witness


def test_the_gate_is_what_one_true_difference_in_ten_thousand_passes():
    from scipy.stats import chi2

    assert chi2.sf(GATE, 6) == pytest.approx(1e-4, rel=0.01)


def test_differences_as_large_as_the_covariances_say_give_chi_square(rng: np.random.Generator):
    roots = np.linalg.cholesky(COVARIANCE)
    measured = [RelativePose(STEP @ se3.exp(roots @ rng.normal(size=6)), COVARIANCE, "test") for _ in range(2000)]
    predicted = [RelativePose(STEP @ se3.exp(roots @ rng.normal(size=6)), COVARIANCE, "imu") for _ in range(2000)]
    values = [chi2_of(m, p) for m, p in zip(measured, predicted, strict=True)]
    assert np.mean(values) == pytest.approx(6.0, abs=0.3)
    assert np.mean(np.array(values) > 16.81) == pytest.approx(0.01, abs=0.007)


@pytest.mark.parametrize(("sigmas", "axis"), [(7.0, 3), (12.0, 3), (9.0, 0)])
def test_a_widened_covariance_just_agrees(sigmas: float, axis: int):
    measured = off_by(sigmas, axis)
    times = widening(measured, IMU)
    assert times > 1
    assert chi2_of(measured.wider(times), IMU) == pytest.approx(GATE, rel=1e-6)


def test_what_agrees_is_not_widened():
    assert widening(off_by(1.0), IMU) == 1.0


def test_a_step_is_taken_as_it_is_down_weighted_or_rejected_by_how_far_it_is_off():
    witness = started()
    taken, agreement = witness.judge(measured := off_by(3.0), IMU, IMU)
    assert (taken, agreement.verdict) == (measured, "agrees")
    keyframe = KeyframePose(7, STEP, COVARIANCE)
    far = off_by(10.0, drift=0.1 * COVARIANCE, keyframes=(keyframe,))
    taken, agreement = witness.judge(far, IMU, IMU)
    assert agreement.verdict == "down-weighted"
    assert agreement.chi2 == pytest.approx(100.0)
    times = widening(far, IMU)
    for mine, theirs in (
        (taken.covariance, far.covariance),
        (taken.drift, far.drift),
        (taken.keyframes[0].covariance, COVARIANCE),
    ):
        np.testing.assert_allclose(mine, times * theirs)
    np.testing.assert_allclose(taken.pose, far.pose, atol=1e-12)
    taken, agreement = witness.judge(off_by(20.0, keyframes=(keyframe,)), IMU, IMU)
    assert agreement.verdict == "rejected"
    assert (taken.ok, taken.source, taken.keyframes, taken.drift) == (False, "preintegration", (), None)
    assert taken.details["chi2"] > GROSS


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
def test_without_a_witness_nothing_is_tested(measured: RelativePose, predicted: RelativePose | None):
    taken, agreement = started().judge(measured, predicted, IMU)
    assert taken is measured
    assert agreement.verdict == "untested"
    assert agreement.chi2 is None


def rejected_as_often_as_may_be() -> Witness:
    witness = started()
    verdicts = [witness.judge(off_by(50), IMU, IMU)[1].verdict for _ in range(MOST_REJECTED)]
    assert verdicts == ["rejected"] * MOST_REJECTED
    return witness


def test_after_a_few_rejections_a_jump_is_followed_but_not_believed_to_be_motion():
    witness = rejected_as_often_as_may_be()
    taken, agreement = witness.judge(off_by(50), IMU, IMU)
    assert agreement.verdict == "relocated"
    assert (taken.ok, taken.source) == (False, "preintegration")
    np.testing.assert_array_equal(taken.pose, STEP)
    assert witness.judge(off_by(0.5), IMU, IMU)[1].verdict == "agrees"
    assert witness.judge(off_by(50), IMU, IMU)[1].verdict == "rejected"


def test_scans_that_go_on_to_contradict_the_imu_are_trusted_until_one_agrees():
    witness = rejected_as_often_as_may_be()
    verdicts = [witness.judge(off_by(50), IMU, IMU)[1].verdict for _ in range(4)]
    assert verdicts == ["relocated"] + ["trusted again"] * 3
    assert witness.judge(off_by(0.5), IMU, IMU)[1].verdict == "agrees"
    assert witness.judge(off_by(50), IMU, IMU)[1].verdict == "rejected"


# ---------------------------------------------------------------------------------------------------- in a drive


class Slipping(ScanMatching):
    """Scan matching that is sure of a wrong pose at some scans."""

    def __init__(self, wrong: range, by_m: float) -> None:
        super().__init__()
        self._wrong, self._by_m = wrong, by_m

    def refine(self, frame: Frame, initial: RelativePose) -> RelativePose:
        found = super().refine(frame, initial)
        if frame.index not in self._wrong:
            return found
        slipped = se3.exp(np.array([0, 0, 0, self._by_m, 0, 0]))
        self._path.T_map_lidar = self._path.T_map_lidar @ slipped
        return replace(found, pose=found.pose @ slipped)


def driven(sequence: Sequence, source: ScanMatching) -> list[Estimate]:
    odometry = Odometry(residual=source, config=Config())
    return [odometry.step(frame) for frame in sequence]


def farthest_off(estimates: list[Estimate], sequence: Sequence) -> float:
    assert sequence.reference is not None
    poses = np.array([e.pose for e in estimates])
    return float(np.linalg.norm(poses[:, :3, 3] - sequence.reference.poses[:, :3, 3], axis=1).max())


def test_a_registration_that_slips_is_rejected_and_does_no_harm(sequence: Sequence):
    clean, slipped = driven(sequence, ScanMatching()), driven(sequence, Slipping(range(15, 17), 2.0))
    assert {e.agreement.verdict for e in clean[START_STEPS + 1 :]} <= {"agrees", "down-weighted"}
    rejected = [e.index for e in slipped if e.agreement.verdict == "rejected"]
    assert rejected == [15, 16]
    assert [e.index for e in slipped[1:] if e.relative and not e.relative.ok] == rejected
    assert farthest_off(slipped, sequence) < farthest_off(clean, sequence) + 0.05


def test_a_map_that_was_lost_is_found_again_without_the_jump_in_the_path(sequence: Sequence):
    """The registration slips once and says so ever after: where it is told to go back, it slips again."""
    clean, slipped = driven(sequence, ScanMatching()), driven(sequence, Slipping(range(12, 13 + MOST_REJECTED), 1.0))
    verdicts = [e.agreement.verdict for e in slipped[12 : 14 + MOST_REJECTED]]
    assert verdicts == ["rejected"] * MOST_REJECTED + ["relocated", "agrees"]
    bridged_m = 0.2  # six steps by an IMU that started a second ago
    assert farthest_off(slipped, sequence) < farthest_off(clean, sequence) + bridged_m


def test_any_initial_pose_has_the_imu_for_witness(sequence: Sequence):
    odometry = Odometry(initial_pose="constant-velocity", residual=Slipping(range(15, 16), 2.0))
    estimates = [odometry.step(sequence[k]) for k in range(18)]
    assert [e.index for e in estimates if e.agreement.verdict == "rejected"] == [15]
