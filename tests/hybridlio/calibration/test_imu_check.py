"""What the comparison of an IMU with a lidar's path corrects, doubts and refuses, mistake by mistake."""

from dataclasses import replace

import numpy as np
import pytest
from handheld import MOUNTING, Handheld, carried, changed

from hybridlio.calibration.imu_check import ImuCheck, check_imu, moved
from hybridlio.core import se3
from hybridlio.core.sensors import ImuSamples
from hybridlio.core.trajectory import Trajectory


@pytest.fixture(scope="module")
def walk() -> Handheld:
    return carried(np.random.default_rng(5), seconds=15.0)


def check(walk: Handheld, imu: ImuSamples | None = None, T_imu_lidar: np.ndarray = MOUNTING) -> ImuCheck:
    scatter = se3.exp(np.random.default_rng(1).normal(0, [3e-4] * 3 + [5e-3] * 3, (len(walk.path), 6)))
    path = Trajectory(walk.path.stamps_ns, walk.path.poses @ scatter)
    return check_imu([path], walk.imu if imu is None else imu, T_imu_lidar, 0.2)


def test_right_data_pass_unchanged_and_without_a_word(walk: Handheld):
    found = check(walk)
    assert (found.corrected, found.doubtful, found.wrong) == ([], [], [])
    assert found.imu is walk.imu


@pytest.mark.parametrize("late_s", [0.15, -0.05])
def test_a_clock_that_is_off_is_corrected_with_the_line_that_states_it(walk: Handheld, late_s: float):
    found = check(walk, moved(walk.imu, late_s))
    assert found.offset is not None
    assert found.offset.offset_s == pytest.approx(-late_s, abs=1e-3)
    assert "'imu_time_offset_s: " in found.corrected[0]
    np.testing.assert_allclose(found.imu.stamps_ns, walk.imu.stamps_ns, atol=1e6)


def test_a_gyroscope_in_degrees_is_converted(walk: Handheld):
    found = check(walk, changed(walk.imu, gyro=np.rad2deg))
    assert "are in °/s" in found.corrected[0]
    np.testing.assert_allclose(found.imu.gyro_rad_s, walk.imu.gyro_rad_s)
    assert not found.wrong


def test_rates_converted_twice_are_converted_back(walk: Handheld):
    found = check(walk, changed(walk.imu, gyro=np.deg2rad))
    assert "as if in °/s" in found.corrected[0]
    np.testing.assert_allclose(found.imu.gyro_rad_s, walk.imu.gyro_rad_s)


def test_a_gyroscope_of_another_scale_is_doubtful(walk: Handheld):
    assert "3 times those of the scans" in check(walk, changed(walk.imu, gyro=lambda w: 3 * w)).doubtful[0]


@pytest.mark.parametrize(("unit", "reading"), [("g", 1 / 9.81), ("mg", 1000 / 9.81), ("mm/s²", 1000.0)])
def test_a_specific_force_in_another_unit_is_converted(walk: Handheld, unit: str, reading: float):
    found = check(walk, changed(walk.imu, accel=lambda f: f * reading))
    assert f"is in {unit}" in found.corrected[0]
    np.testing.assert_allclose(found.imu.accel_m_s2, walk.imu.accel_m_s2, rtol=1e-3)
    assert not found.wrong


def test_an_accelerometer_of_the_wrong_sign_is_negated(walk: Handheld):
    found = check(walk, changed(walk.imu, accel=np.negative))
    assert "wrong sign" in found.corrected[0]
    np.testing.assert_allclose(found.imu.accel_m_s2, walk.imu.accel_m_s2)
    assert not found.wrong


def test_missing_gravity_is_an_error(walk: Handheld):
    poses = Trajectory(walk.path.stamps_ns, walk.path.poses @ se3.inverse(MOUNTING))
    nearest = np.clip(np.searchsorted(poses.stamps_ns, walk.imu.stamps_ns), 0, len(poses) - 1)
    gravity = np.swapaxes(poses.poses[nearest, :3, :3], 1, 2) @ [0, 0, 9.81]
    found = check(walk, changed(walk.imu, accel=lambda f: f - gravity))
    assert "gravity is missing" in found.wrong[0]
    assert "leave the IMU out" in found.wrong[0]


@pytest.mark.parametrize("order", [(1, 2, 0), (2, 0, 1)])
def test_axes_in_another_order_are_an_error_that_gives_the_mounting(walk: Handheld, order: tuple[int, ...]):
    columns = list(order)
    found = check(walk, changed(walk.imu, lambda w: w[:, columns], lambda f: f[:, columns]))
    assert "axes are swapped or turned" in found.wrong[0]
    assert "T_imu_lidar: {translation: [" in found.wrong[0]


def test_mirrored_axes_are_an_error(walk: Handheld):
    flip = np.array([1, -1, 1])
    found = check(walk, changed(walk.imu, lambda w: w * flip, lambda f: f * flip))
    assert "mirrored: its x, y, z should be x, -y, z of the data" in found.wrong[0]


def test_a_mirrored_gyroscope_alone_is_named(walk: Handheld):
    found = check(walk, changed(walk.imu, gyro=lambda w: w * [1, 1, -1]))
    assert found.wrong[0].startswith("gyroscope: ")


def test_the_inverse_of_the_mounting_is_named(walk: Handheld):
    turned = MOUNTING @ se3.exp([0, 0, 0.5, 0, 0, 0])
    path = replace(walk, path=Trajectory(walk.path.stamps_ns, walk.path.poses @ se3.exp([0, 0, 0.5, 0, 0, 0])))
    found = check(path, T_imu_lidar=se3.inverse(turned))
    assert "T_imu_lidar is the inverse" in found.wrong[0]
    assert f"translation: [{turned[0, 3]:.3f}" in found.wrong[0]


@pytest.mark.parametrize("degrees", [5, 10])
def test_a_mounting_that_is_a_few_degrees_off_is_doubtful_and_the_right_one_given(walk: Handheld, degrees: float):
    off = se3.exp(np.deg2rad(degrees) * np.array([0.6, -0.8, 0, 0, 0, 0]))
    found = check(walk, T_imu_lidar=off @ MOUNTING)
    assert f"turned by {degrees}." in found.doubtful[0] or f"turned by {degrees - 1}." in found.doubtful[0]
    assert "roll_pitch_yaw_deg" in found.doubtful[0]


def test_a_straight_ride_says_nothing():
    still = carried(np.random.default_rng(2), seconds=8.0, turning=0.0)
    found = check(still)
    assert (found.corrected, found.doubtful, found.wrong) == ([], [], [])
