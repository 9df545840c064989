"""Scans at a low rate without an IMU: large turns between them, and sweeps of which the motion is not seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from walks import errors_of, estimated, squared_position_errors, walk

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.estimates import RelativePose
from hybridlio.core.sensors import NS_PER_S, Calibration, Frame, ImuNoise, ImuSamples, Scan
from hybridlio.core.start_state import start_state
from hybridlio.core.trajectory import Trajectory
from hybridlio.odometry.compensation import MotionCompensation
from hybridlio.registration.motion_search import rotated
from hybridlio.simulation.platforms.config import PlatformConfig
from hybridlio.sources.constant_velocity import ConstantVelocity

TURNS = PlatformConfig(scene="office", platform="handheld", lidar="os0", seconds=1.8, seed=9422)


def frame_at(time_s: float, sweep_s: float = 0.1) -> Frame:
    offsets_ns = np.linspace(0, sweep_s * NS_PER_S, 11).astype(np.int64)
    scan = Scan(int(time_s * NS_PER_S), np.ones((11, 3), np.float32), time_offsets_ns=offsets_ns)
    return Frame(0, scan, ImuSamples.empty(), calibration=Calibration())


def predicted_after(times_s: list[float], twists: list[Array]) -> RelativePose:
    """Return the prediction for the last time, after steps of these twists to those between."""
    source = ConstantVelocity()
    for before_s, now_s, twist in zip(times_s, times_s[1:-1], twists, strict=False):
        frame = frame_at(now_s)
        initial = source.predict(frame, start_state(int(before_s * NS_PER_S), ImuSamples.empty(), ImuNoise()))
        source.correct(frame, replace(initial, pose=se3.exp(twist * (now_s - before_s))))
    before_ns = frame_at(times_s[-2]).scan.stamp_ns
    return source.predict(frame_at(times_s[-1]), start_state(before_ns, ImuSamples.empty(), ImuNoise()))


def test_a_twist_is_the_less_certain_the_more_it_has_changed() -> None:
    calm, wild = np.zeros(6), np.r_[0.0, 0.0, 1.5, 0.3, 0.0, 0.0]
    times_s = [0.0, 0.5, 1.0, 1.5, 2.0]
    steady = predicted_after(times_s, [calm, calm, calm]).covariance
    shaken = predicted_after(times_s, [calm, wild, calm]).covariance
    assert np.sqrt(steady[2, 2]) == pytest.approx(0.5 * 0.5 * 0.5, rel=0.01)
    assert np.sqrt(shaken[2, 2]) == pytest.approx(1.5 / np.sqrt(3) * 0.5, rel=0.01)


def test_a_twist_is_the_less_certain_the_older_it_is() -> None:
    source = ConstantVelocity()
    step = source.predict(frame_at(0.1), start_state(0, ImuSamples.empty(), ImuNoise()))
    source.correct(frame_at(0.1), step)
    sigmas = []
    for before_s in (0.1, 0.2):  # the scan at 0.2 s is not found
        state = start_state(int(before_s * NS_PER_S), ImuSamples.empty(), ImuNoise())
        sigmas.append(source.predict(frame_at(before_s + 0.1), state).translation_sigma_m)
    assert sigmas[1] / sigmas[0] == pytest.approx(2.0, rel=0.01)


def test_motion_between_sweeps_is_unseen_and_within_them_is_not() -> None:
    compensation = MotionCompensation(Calibration(), ImuNoise())
    at_once, with_gap = (compensation.noise(frame_at(step_s), 0) for step_s in (0.1, 0.5))
    assert at_once is not None
    assert with_gap is not None
    assert np.sqrt(at_once[5, 5]) < 1e-9
    mean_s = 0.1 * np.sqrt(0.35)  # root mean square of the offsets 0, 0.01, … 0.1 s
    assert np.sqrt(with_gap[5, 5]) == pytest.approx(np.sqrt(2) * 0.8 * 2.0 * 0.5 * mean_s, rel=0.01)


def test_rotations_are_tried_as_far_as_bodies_turn() -> None:
    before, start = np.eye(4), se3.exp(np.r_[0.0, 0.0, 0.3, 1.0, 0.0, 0.0])
    slow = rotated(before, start, 0.5)
    assert np.array_equal(slow[0], se3.make(np.eye(3), start[:3, 3]))
    assert not rotated(before, start, 0.1)
    assert 100 < len(slow) < 1000
    for angle_deg in (-70.0, -41.0, 65.0):
        turn = se3.make(se3.so3_exp(np.array([0.0, 0.0, np.radians(angle_deg)])), start[:3, 3])
        nearest = min(np.linalg.norm(se3.log(se3.between(turn, one))[:3]) for one in slow)
        assert np.degrees(nearest) <= 4.01


def test_turns_of_half_a_second_without_imu_are_found_or_doubted() -> None:
    recording = walk(TURNS, count=16)
    frames = [replace(one, imu=ImuSamples.empty(), sweep_imu=ImuSamples.empty()) for one in list(recording)[::5]]
    assert recording.reference is not None
    truth = Trajectory(recording.reference.stamps_ns[::5], recording.reference.poses[::5])
    turned_deg = np.degrees(np.linalg.norm(se3.log(se3.between(truth.poses[:-1], truth.poses[1:]))[:, :3], axis=1))
    assert turned_deg.max() > 20
    estimates = estimated(frames)
    errors = errors_of(estimates, truth)
    assert squared_position_errors(estimates, errors).max() < 3
    assert max(np.linalg.norm(error[3:]) for error in errors) < 0.2
