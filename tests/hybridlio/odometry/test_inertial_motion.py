"""Motion around a sweep by the IMU: platforms that turn without their path turning, and the reverse."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.estimates import State
from hybridlio.core.sensors import Calibration, ImuNoise, ImuSamples
from hybridlio.core.start_state import start_state
from hybridlio.odometry.inertial_motion import inertial_motion, lidar_turn

GRAVITY = np.array([0.0, 0.0, -9.81])
MOUNT = se3.exp(np.array([0.4, -0.3, 2.0, 0.1, -0.2, 0.3]))
STAMPS = np.arange(-40, 141, 5) * 1_000_000  # 200 Hz, from before the step to after it
END_NS = 100_000_000
GYRO_BIAS, ACCEL_BIAS = np.array([0.01, -0.02, 0.03]), np.array([0.1, 0.2, -0.1])

Path = Callable[[float], np.ndarray]


def drone(t: float) -> np.ndarray:
    """Spins at 6 rad/s about a tilted axis, flies straight and brakes."""
    return se3.make(se3.so3_exp(np.array([2.0, 1.0, 5.5]) * t), np.array([5.0, 1.0, 0.5]) * t - [3.0 * t**2, 0, 0])


def car(t: float) -> np.ndarray:
    """Drives at 15 m/s through a bend of 20 m radius."""
    yaw = 15.0 / 20.0 * t
    return se3.make(se3.so3_exp(np.array([0, 0, yaw])), 20.0 * np.array([np.sin(yaw), 1 - np.cos(yaw), 0.0]))


def measured(path: Path) -> ImuSamples:
    gyro, force, h = [], [], 1e-4
    for t in STAMPS / 1e9:
        before, now, after = (path(t + k * h) for k in (-1, 0, 1))
        gyro.append(se3.so3_log(before[:3, :3].T @ after[:3, :3]) / (2 * h) + GYRO_BIAS)
        acceleration = (before[:3, 3] - 2 * now[:3, 3] + after[:3, 3]) / h**2
        force.append(now[:3, :3].T @ (acceleration - GRAVITY) + ACCEL_BIAS)
    return ImuSamples(STAMPS, np.array(gyro), np.array(force))


def state(path: Path) -> State:
    begin = start_state(0, ImuSamples.empty(), ImuNoise())
    return replace(
        begin, T_world_imu=path(0.0), gravity_m_s2=GRAVITY, gyro_bias_rad_s=GYRO_BIAS, accel_bias_m_s2=ACCEL_BIAS
    )


@pytest.mark.parametrize("path", [drone, car])
def test_the_path_is_followed_through_the_sweep_and_before_the_step(path: Path):
    true = np.array([path(t) for t in STAMPS / 1e9]) @ MOUNT
    step = se3.between(path(0.0) @ MOUNT, path(0.1) @ MOUNT)
    motion = inertial_motion(measured(path), state(path), step, END_NS, Calibration(MOUNT))
    assert motion is not None
    errors = se3.log(se3.between(true, motion.poses))
    assert np.abs(errors[:, :3]).max() < 1e-4
    assert np.abs(errors[:, 3:]).max() < 1e-3  # 3 cm of braking and 5 cm of the bend, within 1 mm


def test_rates_of_a_wrong_scale_are_changed_to_turn_as_the_motion_does():
    """A drone turns by 34° in the step; sensitivities off by 1.5 % and mixed axes leave 0.44°."""
    true = np.array([drone(t) for t in STAMPS / 1e9]) @ MOUNT
    step = se3.between(drone(0.0) @ MOUNT, drone(0.1) @ MOUNT)
    imu, scale = measured(drone), np.array([[1.015, 0.01, -0.005], [0.005, 0.985, 0.01], [-0.01, 0.005, 1.015]])
    wrong = replace(imu, gyro_rad_s=imu.gyro_rad_s @ scale.T)
    errors = []
    for by_gyroscope in (True, False):
        motion = inertial_motion(wrong, state(drone), step, END_NS, Calibration(MOUNT), by_gyroscope)
        assert motion is not None
        errors.append(np.abs(se3.log(se3.between(true, motion.poses))[:, :3]).max())
    assert errors[0] > np.radians(0.4)
    assert errors[1] < 0.3 * errors[0]


def test_within_their_first_period_samples_keep_their_rate_whatever_the_step_turns():
    """Steps that two distorted scans show are off by a degree, and 3 ms could make it up with a rate of 6 rad/s."""
    imu, begin_ns = measured(drone), -3_000_000
    from_0 = ImuSamples(imu.stamps_ns[8:], imu.gyro_rad_s[8:], imu.accel_m_s2[8:])
    begin = replace(state(drone), stamp_ns=begin_ns, T_world_imu=drone(begin_ns / 1e9))
    step = se3.between(begin.T_world_imu @ MOUNT, drone(END_NS / 1e9) @ MOUNT)
    wrong = step @ se3.exp(np.array([0.015, -0.015, 0.015, 0.0, 0.0, 0.0]))
    motion = inertial_motion(from_0, begin, wrong, END_NS, Calibration(MOUNT))
    assert motion is not None
    true = np.array([drone(t) for t in motion.stamps_ns / 1e9]) @ MOUNT
    assert np.abs(se3.log(se3.between(true, motion.poses))[:, :3]).max() < 1e-4


def test_the_lidars_turn_is_that_of_its_path():
    step = se3.between(drone(0.0) @ MOUNT, drone(0.1) @ MOUNT)
    imu = measured(drone)
    within = (imu.stamps_ns >= 0) & (imu.stamps_ns <= END_NS)
    samples = ImuSamples(imu.stamps_ns[within], imu.gyro_rad_s[within], imu.accel_m_s2[within])
    turn = lidar_turn(samples, state(drone), Calibration(MOUNT))
    assert np.linalg.norm(se3.so3_log(step[:3, :3].T @ turn)) < 1e-4


def test_without_samples_at_both_ends_or_with_a_gap_there_is_no_motion():
    imu, begin, calibration = measured(drone), state(drone), Calibration(MOUNT)
    assert inertial_motion(imu, replace(begin, stamp_ns=1), np.eye(4), END_NS, calibration) is None
    assert inertial_motion(imu, begin, np.eye(4), END_NS + 1, calibration) is None
    late = ImuSamples(np.r_[STAMPS[:-1], 900_000_000], imu.gyro_rad_s, imu.accel_m_s2)
    assert inertial_motion(late, begin, np.eye(4), END_NS, calibration) is None
