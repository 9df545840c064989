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


@pytest.mark.parametrize(
    ("weighs", "predicted_m", "matched_m", "share"),
    [(True, 1.0, 1e-4, 1.0), (True, 0.01, 0.01, 0.5), (True, 1e-4, 0.01, 0.0), (False, 1e-4, 0.01, 1.0)],
)
def test_a_scan_is_compensated_again_by_what_its_match_knows_better(
    weighs: bool, predicted_m: float, matched_m: float, share: float
) -> None:
    """Stamped at its end, a sweep whose speed is wrong by δ is displaced by -δ/2 of a step, and its match so by δ/2."""
    step_ns, wrong_m = 100_000_000, np.array([0.2, -0.1, 0.3])
    scan = Scan(step_ns, np.ones((101, 3), np.float32), time_offsets_ns=np.linspace(-step_ns, 0, 101).astype(np.int64))

    def step(position_m: Array, position_sigma_m: float) -> RelativePose:
        covariance = np.diag(np.r_[np.full(3, 1e-3), np.full(3, position_sigma_m)] ** 2)
        return RelativePose(se3.make(np.eye(3), position_m), covariance, "given", details={"sigma_m": 0.01})

    found = second_compensation(
        Frame(1, scan),
        step(np.zeros(3), predicted_m),
        step(wrong_m, matched_m),
        start_state.start_state(0, ImuSamples.empty(), ImuNoise()),
        Calibration(),
        ImuNoise(),
        weighs,
    )
    moved_m = np.zeros(3) if found is None else found.T_start_end[:3, 3]
    np.testing.assert_allclose(moved_m, 2 * share * wrong_m, atol=2e-3)


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
