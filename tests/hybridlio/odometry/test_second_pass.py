"""Sweeps that are compensated by a speed and a bias that few scans measure, or by a gyroscope of a wrong scale."""

from __future__ import annotations

import numpy as np
import pytest
from walks import errors_of, estimated, walk

from hybridlio.core import se3, start_state
from hybridlio.core.arrays import Array
from hybridlio.core.estimates import RelativePose
from hybridlio.core.sensors import Calibration, Frame, ImuNoise, ImuSamples, Scan
from hybridlio.datasets.sequence import Sequence
from hybridlio.odometry import measured_step
from hybridlio.odometry.estimate import Estimate
from hybridlio.odometry.second_pass import second_compensation
from hybridlio.simulation.faults import imu_scale_error
from hybridlio.simulation.platforms.config import PlatformConfig

# turns by 33 to 39 degrees a scan after a second
DRONE = PlatformConfig(scene="campus", platform="drone", lidar="vlp-16", seconds=3.0, seed=8931, drive_seed=8933)
WALK = PlatformConfig(scene="campus", platform="handheld", lidar="os0", seconds=2.0, seed=8102)


@pytest.fixture(scope="module")
def recording() -> Sequence:
    return walk(WALK, count=6)


@pytest.fixture(scope="module")
def frames(recording: Sequence) -> list[Frame]:
    return list(recording)


def largest_step_error_m(estimates: list[Estimate], recording: Sequence) -> float:
    """Return the largest position error of the measured steps from the third on."""
    assert recording.reference is not None
    poses, relative = recording.reference.poses, [estimate.relative for estimate in estimates]
    steps = [one.pose for one in relative if one is not None]
    apart = [se3.between(se3.between(poses[k], poses[k + 1]), step) for k, step in enumerate(steps)]
    return max(float(np.linalg.norm(error[:3, 3])) for error in apart[2:])


def yaw_error_rad(estimates: list[Estimate], recording: Sequence) -> float:
    return float(np.abs(np.mean([error[2] for error in errors_of(estimates, recording.reference)[2:]])))


def test_the_first_scans_lie_as_later_ones_and_steps_do_not_swing_although_bias_and_speed_are_unknown(
    frames: list[Frame], recording: Sequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    estimates = estimated(frames)
    assert yaw_error_rad(estimates, recording) < 5e-4
    assert largest_step_error_m(estimates, recording) < 0.02

    monkeypatch.setattr(measured_step, "_with_turn_rate", lambda *given: given[-1])  # the bias of the first scans stays
    turned = estimated(frames)
    assert yaw_error_rad(turned, recording) > 8e-4

    monkeypatch.setattr(measured_step, "_MOST_REPETITIONS", 1)  # the speed and the vertical at the start stay wrong
    monkeypatch.setattr(start_state, "_force_at", lambda _, imu: imu.accel_m_s2)
    assert largest_step_error_m(estimated(frames), recording) < 0.02
    monkeypatch.setattr(measured_step, "second_compensation", lambda *_: None)
    assert largest_step_error_m(estimated(frames), recording) > 0.03


def compensated_again_m(predicted_m: Array, covered_m: float, found_m: Array, match_m: float, weighs: bool) -> Array:
    """Return the translation ``(3,)`` by which a sweep stamped at its end is compensated again.

    Args:
        predicted_m, covered_m: the initial pose and its standard deviation.
        found_m, match_m: the match and its standard deviation.
        weighs: whether the initial pose counts.
    """
    step_ns = 100_000_000
    scan = Scan(step_ns, np.ones((101, 3), np.float32), time_offsets_ns=np.linspace(-step_ns, 0, 101).astype(np.int64))

    def step(position_m: Array, sigma_m: float) -> RelativePose:
        covariance = np.diag(np.r_[np.full(3, 1e-3), np.full(3, sigma_m)] ** 2)
        return RelativePose(se3.make(np.eye(3), position_m), covariance, "given", details={"sigma_m": 1e-6})

    start = start_state.start_state(0, ImuSamples.empty(), ImuNoise())
    given = step(predicted_m, covered_m), step(found_m, match_m)
    found = second_compensation(Frame(1, scan), *given, start, Calibration(), ImuNoise(), weighs)
    return predicted_m if found is None else np.asarray(found.T_start_end[:3, 3])


@pytest.mark.parametrize(
    ("weighs", "predicted_m", "matched_m", "share"),
    [(True, 1.0, 1e-4, 2.0), (True, 0.01, 0.01, 0.4), (True, 1e-4, 0.01, 0.0), (False, 1e-4, 0.01, 1.0)],
)
def test_a_scan_is_compensated_again_by_what_its_match_knows_better(
    weighs: bool, predicted_m: float, matched_m: float, share: float
) -> None:
    """Stamped at its end, a sweep whose speed is wrong by δ is displaced by -δ/2 of a step, and its match so by δ/2."""
    apart_m = np.array([0.2, -0.1, 0.3])
    moved_m = compensated_again_m(np.zeros(3), predicted_m, apart_m, matched_m, weighs)
    np.testing.assert_allclose(moved_m, share * apart_m, atol=2e-3)


@pytest.mark.parametrize("match_m", [0.003, 0.01, 0.03])
def test_a_weighed_second_compensation_is_closer_than_the_first_and_than_the_match(
    rng: np.random.Generator, match_m: float
) -> None:
    """The truth is 0, and a match is displaced by half of the prediction's error."""
    predicted_m, draws = 0.01, 400
    wrong_m = rng.normal(0.0, predicted_m, (draws, 3))
    found_m = wrong_m / 2 + rng.normal(0.0, match_m, (draws, 3))

    def left_m(weighs: bool) -> float:
        pairs = zip(wrong_m, found_m, strict=True)
        again = [compensated_again_m(wrong, predicted_m, found, match_m, weighs) for wrong, found in pairs]
        return float(np.sqrt(np.mean(np.square(again))))

    assert left_m(weighs=True) < min(left_m(weighs=False), predicted_m)


def test_without_a_known_speed_the_error_of_the_scan_before_is_not_multiplied() -> None:
    """A scan that is placed right beside one that was placed 2 cm off has a step that is 2 cm off."""
    wrong_m = np.array([0.02, 0.0, -0.01])
    again_m = compensated_again_m(np.zeros(3), 1.0, wrong_m, 0.01, weighs=False)
    assert np.linalg.norm(again_m) <= (1 + 1e-9) * np.linalg.norm(wrong_m)


def test_a_gyroscope_of_a_wrong_scale_distorts_fast_turns_less(monkeypatch: pytest.MonkeyPatch) -> None:
    """1.5 % of a turn of 39° within a sweep is 0.6°."""
    flight = imu_scale_error(walk(DRONE, count=14), seed=8931)
    assert flight.reference is not None

    def turn_error_deg() -> float:
        errors = errors_of(estimated(list(flight)), flight.reference)
        return float(np.degrees(np.mean([np.linalg.norm(error[:3]) for error in errors[7:]])))

    twice = turn_error_deg()
    monkeypatch.setattr(measured_step, "second_compensation", lambda *_: None)
    assert twice < 0.7 * turn_error_deg()
