"""A platform at rest does not rise or sink along directions that its scans leave open."""

from __future__ import annotations

import numpy as np
import pytest
from walks import errors_of, estimated, squared_position_errors, walk

from hybridlio.core.arrays import Array
from hybridlio.core.estimates import RelativePose, State
from hybridlio.core.sensors import Calibration, Frame, ImuNoise, ImuSamples, Scan
from hybridlio.core.start_state import start_state
from hybridlio.odometry.second_pass import held_at_rest
from hybridlio.simulation.platforms.config import PlatformConfig

UP, AHEAD = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
STEP_NS = 100_000_000


def samples(accel_m_s2: float = 0.0, rate_rad_s: float = 0.0) -> ImuSamples:
    """Return level samples of a step, shaken at 10 Hz and turning."""
    stamps_ns = np.arange(0, STEP_NS + 1, 5_000_000)
    accel = np.tile([0.0, 0.0, 9.81], (len(stamps_ns), 1))
    accel[:, 0] += accel_m_s2 * np.sin(2 * np.pi * stamps_ns / STEP_NS)
    return ImuSamples(stamps_ns, np.tile([0.0, 0.0, rate_rad_s], (len(stamps_ns), 1)), accel)


def held(open_along: Array, moved_m: Array, imu: ImuSamples) -> RelativePose:
    """Return a step that leaves one direction open, as it is held."""
    pose, direction = np.eye(4), np.r_[np.zeros(3), open_along]
    pose[:3, 3] = moved_m
    covariance = np.diag(np.full(6, 1e-6)) + 100 * np.outer(direction, direction)
    step = RelativePose(pose, covariance, "scan-matching", drift=0.1 * covariance, degenerate=direction[None])
    frame = Frame(1, Scan(STEP_NS, np.empty((0, 3), np.float32)), imu, calibration=Calibration())
    before: State = start_state(0, imu, ImuNoise())
    return held_at_rest(Calibration(), frame, step, before)


def test_at_rest_the_open_height_stays() -> None:
    step = held(UP, 0.3 * UP, samples())
    assert abs(step.pose[2, 3]) < 1e-3
    assert np.sqrt(step.covariance[5, 5]) == pytest.approx(0.01, rel=0.01)
    assert step.covariance[3, 3] == pytest.approx(1e-6, rel=0.05)


@pytest.mark.parametrize(
    ("open_along", "moved_m", "imu"),
    [
        (AHEAD, 0.0 * UP, samples()),  # a car in a smooth tunnel
        (UP, 0.3 * UP + 0.05 * AHEAD, samples()),  # on its way
        (UP, 0.3 * UP, samples(accel_m_s2=1.0)),  # in the air
        (UP, 0.3 * UP, samples(rate_rad_s=0.5)),
    ],
)
def test_in_motion_an_open_direction_stays_open(open_along: Array, moved_m: Array, imu: ImuSamples) -> None:
    step = held(open_along, moved_m, imu)
    assert np.allclose(step.pose[:3, 3], moved_m)
    assert step.covariance.max() > 90


@pytest.mark.parametrize("seed", [9402, 9415])
def test_sixteen_beams_at_rest_in_a_room_do_not_rise(seed: int) -> None:
    room = PlatformConfig(scene="room", lidar="vlp-16", seconds=1.5, seed=seed, start_moving=False)
    recording = walk(room)
    estimates = estimated(list(recording))
    errors = errors_of(estimates, recording.reference)
    assert max(np.linalg.norm(error[3:]) for error in errors) < 0.02
    assert squared_position_errors(estimates, errors).max() < 9
