"""The clock of an IMU that is smoothed with another system's poses."""

from pathlib import Path

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.sensors import Calibration, ImuSamples
from hybridlio.core.trajectory import Trajectory
from hybridlio.record.record import Record

CALIBRATION = Calibration(se3.exp([0.1, -0.2, 0.3, 0.5, 0.0, -0.1]))


def drive(rng: np.random.Generator, seconds: float = 30.0) -> tuple[Trajectory, ImuSamples]:
    """Return lidar poses and samples of one drive on one clock."""
    stamps = np.arange(0, round(seconds * 1e9), 10_000_000)
    times = stamps / 1e9
    rates = np.column_stack(
        [0.03 * np.sin(3 * times), 0.03 * np.cos(4 * times), 0.4 * np.sin(0.8 * times + times**2 / 90)]
    )
    turns = se3.so3_exp((rates[1:] + rates[:-1]) / 2 * 0.01)
    R = [np.eye(3)]
    for turn in turns:
        R.append(R[-1] @ turn)
    poses = se3.make(np.array(R), np.column_stack([8 * times, 0 * times, 0 * times]))
    scatter = se3.exp(rng.normal(0, [3e-4] * 3 + [0.01] * 3, (len(stamps), 6)))
    lidar = se3.between(poses[0] @ CALIBRATION.T_imu_lidar, poses @ CALIBRATION.T_imu_lidar @ scatter)
    force = np.swapaxes(np.array(R), 1, 2) @ [0, 0, 9.81]
    gyro = rates + rng.normal(0, 1e-3, rates.shape)
    return Trajectory(stamps[::10], lidar[::10]), ImuSamples(stamps, gyro, force)


@pytest.mark.parametrize("late_s", [0.521, -0.05, 2.0])
def test_an_imu_on_another_clock_is_brought_to_that_of_the_poses(
    rng: np.random.Generator, caplog: pytest.LogCaptureFixture, late_s: float
):
    trajectory, imu = drive(rng)
    late = ImuSamples(imu.stamps_ns + round(late_s * 1e9), imu.gyro_rad_s, imu.accel_m_s2)
    record = Record.from_odometry(trajectory, late, calibration=CALIBRATION)
    assert record.imu_time_offset_s == pytest.approx(-late_s, abs=2e-3)
    assert len(record.notes) == 1
    assert f"stamps moved by {1e3 * record.imu_time_offset_s:+.1f}" in record.notes[0]
    assert record.notes[0] in caplog.text


def test_an_imu_on_the_same_clock_is_left_alone(rng: np.random.Generator):
    trajectory, imu = drive(rng)
    record = Record.from_odometry(trajectory, imu, calibration=CALIBRATION)
    assert record.imu_time_offset_s == 0.0
    assert record.notes == ()
    np.testing.assert_array_equal(record.imu.stamps_ns, imu.between(0, int(trajectory.stamps_ns[-1])).stamps_ns)


def test_a_stated_offset_is_applied_without_a_search(rng: np.random.Generator):
    trajectory, imu = drive(rng)
    late = ImuSamples(imu.stamps_ns + 700_000_000, imu.gyro_rad_s, imu.accel_m_s2)
    record = Record.from_odometry(trajectory, late, calibration=CALIBRATION, imu_time_offset_s=-0.7)
    assert record.imu_time_offset_s == -0.7
    np.testing.assert_array_equal(record.imu.stamps_ns, imu.between(0, int(trajectory.stamps_ns[-1])).stamps_ns)


def test_an_imu_of_another_drive_is_doubtful(rng: np.random.Generator):
    trajectory, imu = drive(rng)
    other = ImuSamples(imu.stamps_ns, np.roll(imu.gyro_rad_s[:, [2, 0, 1]], 1001, axis=0), imu.accel_m_s2)
    record = Record.from_odometry(trajectory, other, calibration=CALIBRATION)
    assert record.imu_time_offset_s == 0.0
    assert "does not measure the turns" in record.notes[0]


def test_offset_and_notes_are_saved(rng: np.random.Generator, tmp_path: Path):
    trajectory, imu = drive(rng)
    late = ImuSamples(imu.stamps_ns + 50_000_000, imu.gyro_rad_s, imu.accel_m_s2)
    record = Record.from_odometry(trajectory, late, calibration=CALIBRATION)
    record.save(tmp_path / "odometry.npz")
    loaded = Record.load(tmp_path / "odometry.npz")
    assert (loaded.imu_time_offset_s, loaded.notes) == (record.imu_time_offset_s, record.notes)


def test_a_stated_offset_that_is_wrong_does_not_hide_in_the_noise_of_the_odometry(rng: np.random.Generator):
    """The odometry's covariances are those that the right clock shows, so that smoothing notices the contradiction."""
    trajectory, imu = drive(rng)
    right = Record.from_odometry(trajectory, imu, calibration=CALIBRATION)
    wrong = Record.from_odometry(trajectory, imu, calibration=CALIBRATION, imu_time_offset_s=0.3)
    assert "show a further offset of the clocks of -300" in wrong.notes[0]
    np.testing.assert_allclose(wrong.relative[50].covariance, right.relative[50].covariance, rtol=0.1)
    assert wrong.imu_time_offset_s == 0.3


@pytest.mark.parametrize(
    ("late_s", "steps", "note"),
    [
        (1000.0, None, "no IMU sample lies in the time of the poses, they are 9"),
        (0.0, 30, "too few steps between poses have IMU samples"),
    ],
)
def test_clocks_that_were_not_compared_are_noted(rng: np.random.Generator, late_s: float, steps: int | None, note: str):
    trajectory, imu = drive(rng)
    late = ImuSamples(imu.stamps_ns + round(late_s * 1e9), imu.gyro_rad_s, imu.accel_m_s2)
    short = Trajectory(trajectory.stamps_ns[:steps], trajectory.poses[:steps])
    record = Record.from_odometry(short, late, calibration=CALIBRATION)
    assert record.notes[0].startswith(note)


def test_a_drive_that_does_not_turn_does_not_tell_the_offset_and_says_so(rng: np.random.Generator):
    stamps = np.arange(0, 20_000_000_001, 10_000_000)
    straight = se3.make(np.tile(np.eye(3), (201, 1, 1)), np.column_stack([np.arange(201), *np.zeros((2, 201))]))
    gyro = rng.normal(0, 1e-3, (len(stamps), 3))
    imu = ImuSamples(stamps, gyro, np.tile([0, 0, 9.81], (len(stamps), 1)))
    record = Record.from_odometry(Trajectory(stamps[::10], straight), imu)
    assert "do not determine the offset of the clocks" in record.notes[0]
