from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scans import blind

from hybridlio.core import se3
from hybridlio.core.errors import ConfigError, DataError, EstimationError
from hybridlio.core.estimates import RelativePose
from hybridlio.core.sensors import Frame, GpsFix, ImuSamples
from hybridlio.datasets.sequence import Sequence
from hybridlio.graph.run.smooth import smooth
from hybridlio.odometry.config import Config
from hybridlio.odometry.estimate import Estimate
from hybridlio.odometry.odometry import Odometry
from hybridlio.record.record import Record
from hybridlio.sources.residual_chain import NoResidual


@pytest.fixture(scope="module")
def driven(frames: list[Frame]) -> tuple[Odometry, list[Estimate]]:
    odometry = Odometry()
    return odometry, [odometry.step(frame) for frame in frames]


def quick() -> Odometry:
    """Return an odometry that ignores scans, for tests that do not need them."""
    return Odometry(residual="none")


# -------------------------------------------------------------------------------------------------- a drive


def test_a_tiny_drive_is_followed_to_a_few_centimetres(driven: tuple[Odometry, list[Estimate]], sequence: Sequence):
    assert sequence.reference is not None
    errors = se3.log(se3.between(np.array([e.pose for e in driven[1]]), sequence.reference.poses))
    assert sequence.reference.length_m > 15
    # 16 beams hardly observe pitch, so most of the error is in height
    assert np.linalg.norm(errors[:, 3:5], axis=1).max() < 0.05
    assert np.abs(errors[:, 5]).max() < 0.2
    assert np.degrees(np.linalg.norm(errors[:, :3], axis=1).max()) < 0.5


def test_errors_are_within_the_covariances(driven: tuple[Odometry, list[Estimate]], sequence: Sequence):
    assert sequence.reference is not None
    errors = se3.log(se3.between(np.array([e.pose for e in driven[1]]), sequence.reference.poses))
    sigmas = np.sqrt([np.diag(e.covariance) for e in driven[1]])
    assert (np.abs(errors[5:, 3:5]) < 5 * sigmas[5:, 3:5]).all()


def test_every_covariance_is_symmetric_and_positive_definite(driven: tuple[Odometry, list[Estimate]]):
    for estimate in driven[1]:
        np.testing.assert_allclose(estimate.covariance, estimate.covariance.T, rtol=1e-9, atol=1e-18)
        np.linalg.cholesky(estimate.covariance)
        for part in (estimate.initial, estimate.relative, estimate.step):
            if part is not None:
                np.linalg.cholesky(part.covariance)


def test_the_residual_times_the_initial_pose_is_the_relative_pose(driven: tuple[Odometry, list[Estimate]]):
    for estimate in driven[1][1:]:
        assert estimate.initial is not None
        assert estimate.relative is not None
        np.testing.assert_allclose(estimate.residual @ estimate.initial.pose, estimate.relative.pose, atol=1e-12)
    assert np.linalg.norm(driven[1][1].residual[:3, 3]) > 0.5  # the unknown speed


def test_the_first_estimate_is_the_origin_without_a_step(driven: tuple[Odometry, list[Estimate]]):
    first = driven[1][0]
    np.testing.assert_array_equal(first.pose, np.eye(4))
    np.testing.assert_array_equal(first.residual, np.eye(4))
    assert (first.initial, first.relative, first.step) == (None, None, None)
    assert np.sqrt(np.diag(first.covariance)).max() < 1e-5


def test_estimates_carry_index_stamp_and_time_spent(driven: tuple[Odometry, list[Estimate]], frames: list[Frame]):
    for estimate, frame in zip(driven[1], frames, strict=True):
        assert (estimate.index, estimate.stamp_ns) == (frame.index, frame.scan.stamp_ns)
    stages = driven[1][5].seconds
    assert set(stages) == {"initial pose", "motion compensation", "residual", "graph", "keyframes"}
    assert all(seconds >= 0 for seconds in stages.values())


def test_an_estimates_repr_is_one_line(driven: tuple[Odometry, list[Estimate]], frames: list[Frame]):
    assert repr(driven[1][0]) == "Estimate(frame 0, position (0.00, 0.00, 0.00) m ± 1.7e-06 m, untested)"
    assert repr(driven[1][-1]).startswith(f"Estimate(frame {len(frames) - 1}, position (")
    odometry = Odometry()
    odometry.step(frames[0])
    assert repr(odometry.step(blind(frames[1]))).endswith("untested, bridged)")


def test_the_last_step_leads_from_the_pose_before_to_the_newest(driven: tuple[Odometry, list[Estimate]]):
    before, last = driven[1][-2:]
    assert last.step is not None
    assert np.linalg.norm(se3.between(before.pose @ last.step.pose, last.pose)[:3, 3]) < 0.05


def test_the_same_frames_give_identical_results(driven: tuple[Odometry, list[Estimate]], frames: list[Frame]):
    again = Odometry()
    for frame, first in zip(frames[:8], driven[1], strict=False):
        estimate = again.step(frame)
        assert estimate.pose.tobytes() == first.pose.tobytes()
        assert estimate.covariance.tobytes() == first.covariance.tobytes()


def test_scans_without_points_are_bridged_by_the_imu(frames: list[Frame], sequence: Sequence):
    odometry = Odometry()
    estimates = [odometry.step(blind(f) if 8 <= f.index < 13 else f) for f in frames[:16]]
    assert [e.index for e in estimates if e.relative is not None and not e.relative.ok] == list(range(8, 13))
    assert sequence.reference is not None
    off = [np.linalg.norm(e.pose[:3, 3] - sequence.reference.poses[e.index, :3, 3]) for e in estimates]
    assert max(off) < 0.15
    spread = [np.trace(e.covariance[3:, 3:]) for e in estimates]
    assert spread[12] > spread[8] > spread[7]
    assert spread[13] < spread[12]


# ------------------------------------------------------------------------------------------------- the record


def test_the_record_holds_all_steps_and_samples_of_the_run(
    driven: tuple[Odometry, list[Estimate]], frames: list[Frame], sequence: Sequence, tmp_path: Path
):
    odometry, estimates = driven
    record = odometry.record()
    assert record.online.stamps_ns.tolist() == [frame.scan.stamp_ns for frame in frames]
    np.testing.assert_allclose(record.online.poses, [e.pose for e in estimates], atol=1e-12)
    assert [r.pose.tobytes() for r in record.relative] == [
        e.relative.pose.tobytes() for e in estimates[1:] if e.relative
    ]
    assert len(record.initial) == len(frames) - 1
    assert repr(record).startswith(f"Record({len(frames)} scans, ")
    assert "0 GPS fixes" in repr(record)
    assert record.imu.stamps_ns[0] <= frames[0].scan.stamp_ns
    assert record.imu.stamps_ns[-1] == frames[-1].scan.stamp_ns
    np.testing.assert_allclose(np.diff(record.imu.stamps_ns), 10_000_000, atol=2)
    np.testing.assert_array_equal(record.calibration.T_imu_lidar, sequence.calibration.T_imu_lidar)
    record.save(tmp_path / "odometry.npz")
    saved = smooth(Record.load(tmp_path / "odometry.npz"))
    np.testing.assert_allclose(saved.trajectory.poses, smooth(record).trajectory.poses, atol=1e-9)


def test_smoothing_the_record_stays_near_the_truth(driven: tuple[Odometry, list[Estimate]], sequence: Sequence):
    assert sequence.reference is not None
    smoothed = smooth(driven[0].record()).trajectory
    off = np.linalg.norm(smoothed.poses[:, :3, 3] - sequence.reference.poses[:, :3, 3], axis=1)
    assert off.max() < 0.2


def test_a_record_of_fewer_than_two_frames_is_an_error(frames: list[Frame]):
    odometry = quick()
    with pytest.raises(EstimationError, match="at least two frames"):
        odometry.record()
    odometry.step(frames[0])
    with pytest.raises(EstimationError, match="at least two frames"):
        odometry.record()
    odometry.step(frames[1])
    assert len(odometry.record().relative) == 1


def test_fixes_are_kept_up_to_the_last_scan(frames: list[Frame]):
    odometry = quick()
    for frame in frames[:4]:
        fix = GpsFix(frame.scan.stamp_ns - 1, np.zeros(3), np.eye(3))
        odometry.step(replace(frame, gps=(fix,)))
    assert [fix.stamp_ns for fix in odometry.record().gps] == [f.scan.stamp_ns - 1 for f in frames[:4]]


def test_a_step_that_raises_can_be_repeated(frames: list[Frame]):
    class Faulty(NoResidual):
        broken = False

        def refine(self, frame: Frame, initial: RelativePose) -> RelativePose:  # noqa: ARG002
            if self.broken:
                raise DataError("scan unreadable")
            return initial

    source = Faulty()
    odometry = Odometry(residual=source)
    for frame in frames[:4]:
        odometry.step(frame)
    whole = odometry.record()
    source.broken = True
    with pytest.raises(DataError, match="unreadable"):
        odometry.step(frames[4])
    kept = odometry.record()
    np.testing.assert_array_equal(kept.online.poses, whole.online.poses)
    np.testing.assert_array_equal(kept.imu.stamps_ns, whole.imu.stamps_ns)
    source.broken = False
    odometry.step(frames[4])
    odometry.step(frames[5])
    assert odometry.record().imu.stamps_ns[-1] == frames[5].scan.stamp_ns


# --------------------------------------------------------------------------------------------- invalid input


@pytest.mark.parametrize("second", [0, 1], ids=["backwards", "repeated"])
def test_frames_out_of_order_are_refused_with_their_index(second: int, frames: list[Frame]):
    odometry = quick()
    for k in (0, 1):
        odometry.step(frames[k])
    with pytest.raises(DataError, match=f"frame {second}: .*give frames in order"):
        odometry.step(frames[second])
    assert odometry.step(frames[2]).index == 2


@pytest.mark.parametrize("first_has_imu", [True, False])
def test_samples_without_extrinsics_are_refused(first_has_imu: bool, frames: list[Frame]):
    odometry = quick()
    first, second = (replace(frame, calibration=None) for frame in frames[:2])
    if not first_has_imu:
        odometry.step(replace(first, imu=ImuSamples.empty()))
    with pytest.raises(ConfigError, match=r"frame \d carries IMU samples but no calibration"):
        odometry.step(second if not first_has_imu else first)


def test_after_an_unusable_first_scan_the_next_one_can_be_the_first(frames: list[Frame]):
    odometry = Odometry()
    with pytest.raises(DataError, match="frame 0: only 0 points"):
        odometry.step(blind(frames[0]))
    assert odometry.step(frames[1]).index == 1


@pytest.mark.parametrize("kind", ["initial_pose", "residual", "backend"])
@pytest.mark.parametrize("by", ["argument", "config"])
def test_an_unknown_name_is_refused_before_the_first_frame(kind: str, by: str):
    with pytest.raises(ConfigError, match=r"unknown .* 'lidar-dreams'; choose one of"):
        Odometry(**{kind: "lidar-dreams"}) if by == "argument" else Odometry(config=Config(**{kind: "lidar-dreams"}))
