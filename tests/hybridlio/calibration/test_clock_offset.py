"""The offset of the clocks of lidar and IMU, on rotations that are known."""

from dataclasses import replace

import numpy as np
import pytest

from hybridlio.calibration.clock_offset import _COMPENSATION_S, LEAST_OFFSET_S, ClockOffset, find_clock_offset
from hybridlio.calibration.turns import GyroPath, Turns
from hybridlio.core import se3
from hybridlio.core.sensors import ImuSamples
from hybridlio.core.trajectory import Trajectory

SCATTER_RAD, DRIFT_RAD = 3e-4, 1e-4  # of a registration to a map, per pose and per step
MOUNTING = se3.so3_exp([0.2, -0.4, 1.1])


def rates(times_s: np.ndarray, planar: float = 0.1) -> np.ndarray:
    """Rates of a vehicle that turns left and right, with a little roll and pitch; smooth and without a period."""
    yaw = 0.3 * np.sin(0.9 * times_s) + 0.2 * np.sin(2.3 * times_s + 1)
    roll, pitch = 0.3 * np.sin(3.1 * times_s), 0.3 * np.sin(4.7 * times_s + 0.5)
    return np.column_stack([planar * roll, planar * pitch, yaw])


def recording(
    rng: np.random.Generator,
    offset_s: float,
    seconds: float = 20.0,
    bias: float = 0.003,
    planar: float = 0.1,
    noise_rad_s: float = 1e-3,
    share: float = 1.0,
) -> tuple[Turns, ImuSamples]:
    """Return noisy turns of a lidar at 10 Hz, and a gyroscope at 100 Hz whose stamps are early by ``offset_s``.

    ``noise_rad_s`` is that of a sample, and ``share`` scales the motion.
    """
    fine = np.arange(-1, seconds + 1, 2e-3)
    true = ImuSamples(np.round(fine * 1e9).astype(np.int64), share * rates(fine, planar), np.zeros((len(fine), 3)))
    ends = np.arange(0, seconds, 0.1)
    R = [np.eye(3)]
    path = GyroPath(true, 0)
    for turn in se3.so3_exp(path.turns(ends[:-1], ends[1:])):
        R.append(R[-1] @ turn @ se3.so3_exp(rng.normal(0, DRIFT_RAD, 3)))
    scattered = np.array(R) @ se3.so3_exp(rng.normal(0, SCATTER_RAD, (len(R), 3)))
    poses = se3.make(scattered @ MOUNTING, np.zeros(3))  # of the lidar
    imu = true.between(int(-0.9e9), int((seconds + 0.9) * 1e9))
    rows = slice(0, None, 5)
    gyro = imu.gyro_rad_s[rows] + bias + rng.normal(0, noise_rad_s, imu.gyro_rad_s[rows].shape)
    stamps = imu.stamps_ns[rows] - round(offset_s * 1e9)
    turns = Turns.of(Trajectory(np.round(ends * 1e9).astype(np.int64), poses))
    return turns, ImuSamples(stamps, gyro, np.zeros_like(gyro))


def found(turns: Turns, imu: ImuSamples, largest_s: float = 0.3, R: np.ndarray = MOUNTING) -> ClockOffset:
    result = find_clock_offset(turns, imu, R, largest_s)
    assert result is not None
    return result


@pytest.mark.parametrize("offset_s", [-0.15, -0.01, 0.0, 0.05, 0.15])
def test_an_offset_is_found_to_a_millisecond(rng: np.random.Generator, offset_s: float):
    result = found(*recording(rng, offset_s))
    assert result.offset_s == pytest.approx(offset_s, abs=1e-3)
    assert result.sigma_s < 1e-3
    assert result.is_significant == (offset_s != 0)


def test_an_offset_of_seconds_is_found_in_a_wide_search(rng: np.random.Generator):
    turns, imu = recording(rng, 0.0, seconds=60.0)
    for offset_s in (-3.2, 0.521):
        moved = replace(imu, stamps_ns=imu.stamps_ns - round(offset_s * 1e9))
        assert found(turns, moved, largest_s=5.0).offset_s == pytest.approx(offset_s, abs=1e-3)


def test_offset_rotation_and_bias_have_the_covariance_that_is_stated():
    squares = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        tilt = se3.so3_exp(np.array([0.01, -0.02, 0.015]))
        result = found(*recording(rng, 0.02), R=tilt @ MOUNTING)
        back = se3.so3_log(se3.so3_exp(result.rotation_rad) @ tilt)
        sigma_s = np.sqrt(result.sigma_s**2 - _COMPENSATION_S**2)  # these turns come from no compensated scans
        squares.append(np.r_[(result.offset_s - 0.02) / sigma_s, back / result.rotation_sigma_rad] ** 2)
    means = np.mean(squares, axis=0)
    assert (means > 0.4).all()
    assert (means < 1.9).all()


@pytest.mark.parametrize("share", [0.1, 0.05])
def test_the_noise_of_a_gyroscope_in_calm_motion_is_not_taken_for_information(share: float):
    """With rates as small as the noise of a sample, least squares gives a third of the standard deviation."""
    errors, sigmas = [], []
    for seed in range(20):
        result = found(*recording(np.random.default_rng(seed), 0.02, noise_rad_s=0.01, share=share))
        errors.append(result.offset_s - 0.02)
        sigmas.append(result.sigma_s)
    assert 0.4 < np.mean(np.square(errors) / np.square(sigmas)) < 1.9
    assert np.median(sigmas) > 1e-3


def test_errors_that_agree_over_many_steps_are_in_the_standard_deviation():
    errors = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        turns, imu = recording(rng, 0.02)
        slow = np.repeat(rng.normal(0, 2e-3, (len(turns) // 8 + 1, 3)), 8, axis=0)[: len(turns)]
        result = found(replace(turns, rotvecs=turns.rotvecs + slow), imu)
        errors.append((result.offset_s - 0.02) / result.sigma_s)
    assert 0.4 < np.mean(np.square(errors)) < 1.9


def test_turns_about_an_axis_that_is_not_measured_do_not_count(rng: np.random.Generator):
    turns, imu = recording(rng, 0.05, planar=1.0)
    yaw = np.zeros(turns.rotvecs.shape, bool)
    yaw[:, 2] = True
    false = replace(turns, rotvecs=np.where(yaw, np.roll(turns.rotvecs, 2, axis=0), turns.rotvecs), measured=~yaw)
    result = found(false, imu)
    assert result.offset_s == pytest.approx(0.05, abs=2e-3)
    assert result.sigma_s > found(*recording(rng, 0.05, planar=1.0)).sigma_s


def test_the_gyroscopes_bias_is_found_with_it(rng: np.random.Generator):
    result = found(*recording(rng, 0.05, bias=0.01))
    np.testing.assert_allclose(result.gyro_bias_rad_s, 0.01, atol=1e-3)


def test_a_straight_drive_determines_nothing(rng: np.random.Generator):
    turns, imu = recording(rng, 0.05)
    still = replace(turns, rotvecs=rng.normal(0, SCATTER_RAD, turns.rotvecs.shape))
    quiet = replace(imu, gyro_rad_s=rng.normal(0, 1e-3, imu.gyro_rad_s.shape))
    result = found(still, quiet)
    assert not result.is_determined
    assert not result.is_significant
    assert not result.contradicts


def test_turns_of_another_drive_contradict_the_gyroscope(rng: np.random.Generator):
    turns, _ = recording(rng, 0.0)
    _, imu = recording(rng, 0.0)
    other = replace(imu, gyro_rad_s=np.roll(imu.gyro_rad_s, 731, axis=0)[:, [2, 0, 1]])
    result = found(turns, other)
    assert not result.is_significant
    assert result.contradicts


def test_jumps_of_the_odometry_do_not_decide(rng: np.random.Generator):
    turns, imu = recording(rng, 0.05)
    rotvecs = turns.rotvecs.copy()
    rotvecs[[20, 90, 150]] += [[0.5, 0, 0], [0, -1, 0], [0, 0, 2]]
    assert found(replace(turns, rotvecs=rotvecs), imu).offset_s == pytest.approx(0.05, abs=1e-3)


def test_an_offset_too_small_to_matter_is_not_significant(rng: np.random.Generator):
    result = found(*recording(rng, 0.002, seconds=60.0))
    assert abs(result.offset_s) < LEAST_OFFSET_S
    assert not result.is_significant


def test_gaps_in_the_samples_are_not_compared(rng: np.random.Generator):
    turns, imu = recording(rng, 0.05)
    keep = np.ones(len(imu), bool)
    keep[500:600] = False
    holed = ImuSamples(imu.stamps_ns[keep], imu.gyro_rad_s[keep], imu.accel_m_s2[keep])
    result = found(turns, holed)
    assert result.steps < len(turns) - 9
    assert result.offset_s == pytest.approx(0.05, abs=1e-3)


def test_few_steps_give_no_result(rng: np.random.Generator):
    turns, imu = recording(rng, 0.05, seconds=4.0)
    assert find_clock_offset(turns, imu, MOUNTING, 0.3) is None
    assert find_clock_offset(*recording(rng, 0.0)[:1], ImuSamples.empty(), MOUNTING, 0.3) is None


def test_a_gyroscopes_path_integrates_rotations_exactly(rng: np.random.Generator):
    rate = np.array([0.3, -0.8, 1.2])
    stamps = np.arange(0, 2_000_000_001, 10_000_000)
    path = GyroPath(ImuSamples(stamps, np.tile(rate, (len(stamps), 1)), np.zeros((len(stamps), 3))), 0)
    starts = rng.uniform(0, 1, 20)
    np.testing.assert_allclose(path.turns(starts, starts + 0.7), np.tile(0.7 * rate, (20, 1)), atol=1e-12)
