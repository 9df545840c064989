"""Starts that two scans do not decide are decided over several scans."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from resumed import check_resumed_at
from walks import errors_of, estimated, squared_position_errors, walk

from hybridlio.core import se3
from hybridlio.core.estimates import RelativePose
from hybridlio.core.sensors import NS_PER_S, Frame, ImuNoise, Scan
from hybridlio.datasets.sequence import Sequence
from hybridlio.odometry import measured_step
from hybridlio.odometry.config import Config
from hybridlio.odometry.estimate import Estimate
from hybridlio.odometry.odometry import Odometry
from hybridlio.simulation.platforms.config import PlatformConfig

# Two scans of this recording fit each other better 0.8 m and more away from where they were.
AMBIGUOUS = PlatformConfig(scene="campus", platform="handheld", lidar="mid360", seconds=2.0, seed=8003)
# 16 beams see neither floor nor ceiling here, and two scans do not tell how high the second is.
OPEN_ABOVE = PlatformConfig(scene="office", platform="handheld", lidar="vlp-16", seconds=15.0, seed=8001)
OPEN_ABOVE_FROM = 60
# Here the first two scans do not fit each other, and four leave a flat valley of costs: heights with rotations.
VALLEY = PlatformConfig(scene="office", platform="handheld", lidar="vlp-16", seconds=1.2, seed=8101)
OFFICE = PlatformConfig(scene="office", platform="handheld", lidar="os0", seconds=1.6, seed=8522)
# Starts before one wall, along which nothing shows the motion from the second second on.
WALL = PlatformConfig(scene="office", platform="handheld", lidar="rosette", seconds=12.0, seed=8501)


@pytest.fixture(scope="module")
def recording() -> Sequence:
    return walk(AMBIGUOUS)


@pytest.fixture(scope="module")
def frames(recording: Sequence) -> list[Frame]:
    return list(recording)


@pytest.fixture(scope="module")
def estimates(frames: list[Frame]) -> list[Estimate]:
    return estimated(frames)


def test_an_ambiguous_start_is_vague_and_then_right(estimates: list[Estimate], recording: Sequence) -> None:
    errors = errors_of(estimates, recording.reference)
    assert squared_position_errors(estimates, errors)[1:].max() < 9
    relative = [estimate.relative for estimate in estimates[1:]]
    assert all(isinstance(one, RelativePose) and one.ok for one in relative)
    sigmas_m = [one.translation_sigma_m for one in relative if one is not None]
    assert sigmas_m[0] > 0.3
    assert max(sigmas_m[4:]) < 0.02
    assert max(np.linalg.norm(error[3:]) for error in errors[4:]) < 0.05


def test_the_decision_corrects_the_steps_before(estimates: list[Estimate]) -> None:
    deciding = next(k for k, one in enumerate(estimates) if one.relative is not None and one.relative.earlier_scans)
    relative = estimates[deciding].relative
    assert relative is not None
    assert [one.stamp_ns for one in relative.earlier_scans] == [one.stamp_ns for one in estimates[: deciding - 1]]
    assert np.trace(estimates[deciding].covariance[3:, 3:]) < np.trace(estimates[deciding - 1].covariance[3:, 3:]) / 100


def test_the_decided_poses_together_weigh_as_the_one_motion_that_they_show(estimates: list[Estimate]) -> None:
    deciding = next(one for one in estimates if one.relative is not None and one.relative.earlier_scans)
    relative = deciding.relative
    assert relative is not None
    since_s = [(deciding.stamp_ns - one.stamp_ns) / NS_PER_S for one in relative.earlier_scans]
    # of the speed, by the direction that they know least
    variances = [np.linalg.eigvalsh(one.covariance[3:, 3:])[-1] for one in relative.earlier_scans]
    together = 1 / sum(time_s**2 / variance for time_s, variance in zip(since_s, variances, strict=True))
    longest = variances[0] / len(estimates[: deciding.index]) / since_s[0] ** 2  # of the search's own motion
    assert 0.5 < together / longest < 3


def test_steps_before_the_decision_weigh_little_beside_it(estimates: list[Estimate]) -> None:
    deciding = next(one for one in estimates if one.relative is not None and one.relative.earlier_scans)
    assert deciding.relative is not None
    undecided = [one.relative for one in estimates[1 : deciding.index] if one.relative is not None]
    assert all(one.translation_sigma_m > deciding.relative.translation_sigma_m for one in undecided)


def test_an_undecided_start_is_resumed_to_the_last_bit(frames: list[Frame]) -> None:
    check_resumed_at(2, frames[:6], Config())


@pytest.mark.parametrize("cut", [1, 3])
def test_a_scan_without_points_ends_the_search_and_is_bridged(frames: list[Frame], cut: int) -> None:
    empty = replace(frames[cut], scan=Scan(frames[cut].scan.stamp_ns, np.empty((0, 3), np.float32)))
    estimates = estimated([empty if frame.index == cut else frame for frame in frames[: cut + 2]])
    assert estimates[cut].relative is not None
    assert not estimates[cut].relative.ok
    assert estimates[cut + 1].relative is not None


def test_a_false_fit_of_two_scans_is_not_believed() -> None:
    recording = walk(OPEN_ABOVE, OPEN_ABOVE_FROM, 7)
    estimates = estimated(list(recording))
    errors_m = [np.linalg.norm(error[3:]) for error in errors_of(estimates, recording.reference)]
    assert max(errors_m) < 0.05


def test_a_start_in_a_flat_valley_waits_for_scans_that_settle_it() -> None:
    recording = walk(VALLEY)
    estimates = estimated(list(recording))
    errors = errors_of(estimates, recording.reference)
    assert squared_position_errors(estimates, errors).max() < 9
    assert max(np.linalg.norm(error[3:]) for error in errors) < 0.05
    assert max(np.linalg.norm(error[:3]) for error in errors[8:]) < 0.006


def test_two_scans_that_turn_otherwise_than_the_gyroscope_do_not_decide_a_start(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    recording = walk(OFFICE, 0, 6)
    frames = list(recording)
    R = se3.so3_exp(np.array([0.0, 0.0, np.radians(10.0)]))
    frames[1] = replace(frames[1], scan=replace(frames[1].scan, points=frames[1].scan.points @ R.T.astype(np.float32)))

    def errors() -> tuple[float, float]:
        estimates = estimated(frames)
        found = errors_of(estimates, recording.reference)
        return float(np.linalg.norm(found[-1][:3])), float(squared_position_errors(estimates, found)[1:].max())

    turn_rad, squared = errors()
    assert turn_rad < np.radians(2)
    assert squared < 3
    monkeypatch.setattr(measured_step, "_TURN_SIGMA_RAD", 1.0)  # so that every turn is believed
    turn_rad, squared = errors()
    assert turn_rad > np.radians(10)
    assert squared > 15


def test_a_false_start_that_the_imu_contradicts_is_not_claimed_to_be_sure(
    frames: list[Frame], recording: Sequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(measured_step, "repeats_rows", lambda *_: True)  # so that two scans decide, falsely
    monkeypatch.setattr(measured_step, "LOST_COST", 1.0)
    estimates = estimated(frames)
    errors = errors_of(estimates, recording.reference)
    assert np.linalg.norm(errors[-1][3:]) > 1
    assert squared_position_errors(estimates, errors)[-1] < 3


@pytest.mark.parametrize(("bias_sigma_m_s2", "lowest_m", "highest_m"), [(None, 0.0, 1.0), (0.05, 3.0, 10.0)])
def test_the_bias_of_a_consumer_imu_is_not_taken_for_gravity(
    bias_sigma_m_s2: float | None, lowest_m: float, highest_m: float
) -> None:
    """Its accelerometer is 0.35 m/s² off. Where 0.05 is assumed, the vertical leans and the path runs off."""
    recording = walk(WALL, count=30)
    assumed = None if bias_sigma_m_s2 is None else ImuNoise(accel_bias_sigma_m_s2=bias_sigma_m_s2)
    odometry = Odometry(config=Config(imu_noise=assumed))
    estimates = [odometry.step(frame) for frame in recording]
    errors = errors_of(estimates, recording.reference)
    assert lowest_m <= np.linalg.norm(errors[-1][3:]) <= highest_m
    assert (squared_position_errors(estimates, errors)[1:].max() < 3) == (bias_sigma_m_s2 is None)
