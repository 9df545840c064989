from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from carried_path import carried_path
from gps_fixes import LEVER, SHIFT_S, rmse_m, with_fixes
from online_runs import composed

from hybridlio.core import se3
from hybridlio.core.errors import ConfigError, DataError
from hybridlio.core.sensors import ImuSamples
from hybridlio.graph.run.smooth import smooth
from hybridlio.record.record import Record
from hybridlio.smoothing.calibration import Calibrated, CalibrationPriors, Parameter
from hybridlio.smoothing.gps_options import GpsOptions

OFFSET_S = 0.02  # to add to the samples' stamps
OF_IMU = ("extrinsics", "time_offset")
FROM_SCANS = np.r_[np.full(3, 5e-4), np.full(3, 0.01)]


def wrong_record(drive: Any, seed: int, turned: float = 0.03, moved: float = 0.1, offset_s: float = OFFSET_S) -> Record:
    """Return a drive's record whose extrinsics and samples' stamps are off."""
    rng, record = np.random.default_rng(seed), drive.record(composed(drive))
    T = record.calibration.T_imu_lidar
    stated = se3.make(
        T[:3, :3] @ se3.so3_exp(turned * rng.standard_normal(3)), T[:3, 3] + moved * rng.standard_normal(3)
    )
    imu = ImuSamples(record.imu.stamps_ns - round(offset_s * 1e9), record.imu.gyro_rad_s, record.imu.accel_m_s2)
    return replace(record, imu=imu, calibration=replace(record.calibration, T_imu_lidar=stated))


def errors_of(found: Calibrated, drive: Any, offset_s: float = OFFSET_S) -> dict[str, np.ndarray]:
    true, T = drive.calibration.T_imu_lidar, found.calibration.T_imu_lidar
    return {
        "rotation": se3.so3_log(true[:3, :3].T @ T[:3, :3]),
        "translation": T[:3, 3] - true[:3, 3],
        "time_offset": np.array([found.imu_time_offset_s - offset_s]),
    }


@pytest.fixture(scope="module")
def carried(chain: Callable[..., Any]) -> list[tuple[Any, Calibrated]]:
    """Six walks of 12 s, smoothed from a calibration that is off by degrees, decimetres and 20 ms."""
    out = []
    for seed in range(700, 706):
        drive = chain(seed, carried_path(seed, 12.5), steps=120, step_sigmas=FROM_SCANS, drift_share=0.05)
        out.append((drive, smooth(wrong_record(drive, seed), calibrate=OF_IMU).found["calibration"]))
    return out


@pytest.mark.parametrize("name", ["rotation", "translation", "time_offset"])
def test_the_calibration_of_a_walk_is_found_as_its_covariance_says(carried: list[tuple[Any, Calibrated]], name: str):
    squares = []
    for drive, found in carried:
        error, parameter = errors_of(found, drive)[name], found.parameter(name)
        assert parameter.is_determined
        squares.append(error @ np.linalg.solve(parameter.covariance, error) / len(error))
    assert 0.25 < np.mean(squares) < 2.2  # six clocks: a standard deviation of 0.6


def test_a_walk_of_12_s_determines_the_calibration_well(carried: list[tuple[Any, Calibrated]]):
    errors = [errors_of(found, drive) for drive, found in carried]
    limits = {"rotation": np.deg2rad(0.1), "translation": 0.02, "time_offset": 1e-3}
    for name, limit in limits.items():
        assert np.sqrt(np.mean([error[name] ** 2 for error in errors])) < limit


@pytest.mark.parametrize("stated", [1.0, 2.0])
def test_residuals_tell_by_how_much_all_noise_is_overstated(chain: Callable[..., Any], stated: float):
    drive = chain(708, carried_path(708, 15.5), steps=150, step_sigmas=FROM_SCANS, drift_share=0.05)
    record = drive.record(composed(drive))
    steps = tuple(
        replace(step, covariance=stated**2 * step.covariance, drift=stated**2 * step.drift) for step in record.relative
    )
    noise = replace(record.imu_noise, **{name: stated * value for name, value in vars(record.imu_noise).items()})
    verdict = smooth(replace(record, relative=steps, imu_noise=noise)).verdict
    assert verdict.variance_factor == pytest.approx(stated**-2, rel=0.15)  # 900 degrees of freedom: 5 %


def test_a_scaled_parameter_keeps_the_prior_where_it_is_not_determined():
    free = np.array([[0.0, 0.0, 1.0]])
    found = Parameter("translation", np.zeros(3), np.diag([1e-4, 1e-4, 0.09]), 0.3, free).scaled(0.25)
    np.testing.assert_allclose(found.covariance, np.diag([2.5e-5, 2.5e-5, 0.09]), atol=1e-12)


def test_the_smoothed_path_uses_the_calibration(chain: Callable[..., Any]):
    drive = chain(711, carried_path(711, 10.5), steps=100, step_sigmas=FROM_SCANS, drift_share=0.05)
    wrong = wrong_record(drive, 711)
    with_it, without = smooth(wrong, calibrate=OF_IMU), smooth(wrong)
    assert rmse_m(with_it, drive) < 0.5 * rmse_m(without, drive)
    assert rmse_m(with_it, drive) < 1.2 * rmse_m(smooth(drive.record(composed(drive))), drive)


def test_a_car_on_a_plane_says_that_the_height_is_not_known_and_keeps_it(chain: Callable[..., Any]):
    drive = chain(720, steps=200, step_sigmas=FROM_SCANS, drift_share=0.05)
    wrong = wrong_record(drive, 720)
    found = smooth(wrong, calibrate=OF_IMU).found["calibration"]
    translation = found.parameter("translation")
    assert any("translation: the motion does not determine it along" in doubt for doubt in found.doubts)
    assert np.abs(translation.undetermined @ [0, 0, 1]).max() > 0.9
    np.testing.assert_allclose(translation.undetermined @ translation.change, 0, atol=1e-3)
    assert translation.undetermined @ translation.covariance @ translation.undetermined.T == pytest.approx(
        0.3**2, rel=0.1
    )
    assert found.parameter("time_offset").is_determined


def test_a_vehicle_at_rest_determines_nothing_and_nothing_changes(chain: Callable[..., Any]):
    drive = chain(721, steps=60, speed=0.0, step_sigmas=FROM_SCANS)
    standing = replace(drive.record(composed(drive)))
    found = smooth(standing, calibrate=("time_offset",)).found["calibration"]
    assert found.parameter("time_offset").doubt is not None or found.parameter("time_offset").sigmas[0] < 0.03


def test_an_antenna_stated_one_metre_off_is_found_with_its_clock(chain: Callable[..., Any]):
    drive = chain(51, steps=240, step_sigmas=np.r_[np.full(3, 3e-3), np.full(3, 0.06)])
    record, off = with_fixes(drive, 1, rate_hz=5.0, sigma_m=0.05), LEVER + np.array([1.0, 0.0, 0.0])
    smoothed = smooth(record, gps=GpsOptions(antenna_m=off), calibrate=("lever_arm", "gps_clock"))
    found = smoothed.found["calibration"]
    arm = found.parameter("lever_arm")
    error = found.calibration.antenna_imu_m - LEVER
    assert error @ np.linalg.solve(arm.covariance, error) < 16  # χ² of three: once in a thousand
    assert abs(error[0]) < 0.4
    clock = found.parameter("gps_clock")
    assert abs(clock.change[0] - SHIFT_S) < 4 * clock.sigmas[0]
    np.testing.assert_array_equal(smoothed.found["gps"].antenna_m, found.calibration.antenna_imu_m)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (("lever",), "there is no 'lever'; choose of time_offset"),
        ("time_offset", "takes several names"),
        (("lever_arm",), "lever_arm needs GPS fixes"),
    ],
)
def test_parameters_that_cannot_be_calibrated_are_refused(chain: Callable[..., Any], names: Any, message: str):
    drive = chain(1, steps=5)
    with pytest.raises(ConfigError, match=message):
        smooth(drive.record(composed(drive)), calibrate=names)


def test_priors_may_be_given(chain: Callable[..., Any]):
    drive = chain(712, carried_path(712, 5.5), steps=50, step_sigmas=FROM_SCANS)
    priors = CalibrationPriors(("time_offset",), time_offset_sigma_s=1e-6)
    found = smooth(wrong_record(drive, 1, 0.0, 0.0, 1e-3), calibrate=priors).found["calibration"]
    assert not found.parameter("time_offset").is_determined
    assert abs(found.imu_time_offset_s) < 1e-6


def test_loops_of_another_program_are_closed_and_wrong_ones_are_rejected(chain: Callable[..., Any]):
    drive = chain(713, carried_path(713, 8.5), steps=80, step_sigmas=np.r_[np.full(3, 5e-3), np.full(3, 0.05)])
    true = se3.between(drive.lidar_poses[0], drive.lidar_poses[80])
    wrong = true @ se3.exp([0, 0, 0.5, 4.0, 0, 0])
    covariance = np.diag(np.r_[np.full(3, 1e-6), np.full(3, 1e-4)])
    smoothed = smooth(drive.record(composed(drive)), loops=[(0, 80, true, covariance), (1, 79, wrong, covariance)])
    assert [loop.later for loop in smoothed.found["loops"].kept] == [80]
    error = se3.between(true, se3.between(smoothed.trajectory.poses[0], smoothed.trajectory.poses[80]))
    assert np.linalg.norm(error[:3, 3]) < 0.05
    with pytest.raises(DataError, match="loop 3-99: a loop joins two different scans of 0 to 80"):
        smooth(drive.record(composed(drive)), loops=[(3, 99, true, covariance)])
