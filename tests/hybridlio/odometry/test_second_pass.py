"""Sweeps that are compensated by a speed and a bias that few scans measure, or by a gyroscope of a wrong scale."""

from __future__ import annotations

import numpy as np
import pytest
from walks import errors_of, estimated, walk

from hybridlio.core import se3, start_state
from hybridlio.core.sensors import Frame
from hybridlio.datasets.sequence import Sequence
from hybridlio.odometry import measured_step
from hybridlio.odometry.estimate import Estimate
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
