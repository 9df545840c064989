from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hybridlio.core import se3
from hybridlio.core.estimates import RelativePose, State
from hybridlio.core.sensors import Calibration, Frame, ImuNoise, ImuSamples, Scan
from hybridlio.core.start_state import start_state
from hybridlio.sources.kalman import Kalman

NOISE = ImuNoise()
MOUNT = se3.make(Rotation.from_euler("z", 90, degrees=True).as_matrix(), [0.5, 0.2, -0.8])
SIGMAS = np.r_[np.full(3, 5e-4), np.full(3, 0.01)]


class Drive:
    """Runs a filter along a lidar motion given by its twist over time."""

    def __init__(self, gyro_bias: np.ndarray | None = None, imu: bool = True, mount: np.ndarray = MOUNT) -> None:
        self.filter = Kalman(Calibration(mount), NOISE)
        self.mount, self.imu, self.bias = mount, imu, np.zeros(3) if gyro_bias is None else gyro_bias
        self.rng, self.time_s, self.k = np.random.default_rng(3), 0.0, 0

    def step(self, twist: np.ndarray, dt_s: float = 0.1) -> tuple[RelativePose, np.ndarray]:
        """Predict and correct one step; return the prediction and its error (rad, m)."""
        self.k += 1
        end_s = self.time_s + dt_s
        state: State = start_state(round(self.time_s * 1e9), ImuSamples.empty(), NOISE)
        frame = Frame(self.k, Scan(round(end_s * 1e9), np.empty((0, 3), np.float32)))
        if self.imu:
            stamps = round(self.time_s * 1e9) + np.linspace(0, round(dt_s * 1e9), 11).astype(np.int64)
            gyro = np.tile(self.mount[:3, :3] @ twist[:3] + self.bias, (11, 1))
            gyro = gyro + NOISE.gyro_rad_s_sqrt_hz * np.sqrt(10 / dt_s) * self.rng.standard_normal((11, 3))
            frame = replace(frame, imu=ImuSamples(stamps, gyro, np.zeros((11, 3))))
        predicted, truth = self.filter.predict(frame, state), se3.exp(twist * dt_s)
        measured = truth @ se3.exp(SIGMAS * self.rng.standard_normal(6))
        self.filter.correct(frame, RelativePose(measured, np.diag(SIGMAS**2), "test"))
        self.time_s = end_s
        return predicted, se3.log(se3.between(predicted.pose, truth))


CRUISE = np.array([0.0, 0.0, 0.0, 15.0, 0.0, 0.0])
BEND = np.array([0.0, 0.0, 0.4, 15.0, 0.0, 0.0])


@pytest.mark.parametrize("imu", [True, False])
@pytest.mark.parametrize("twist", [CRUISE, BEND], ids=["straight", "bend"])
def test_a_constant_velocity_is_recovered(twist: np.ndarray, imu: bool):
    drive = Drive(imu=imu)
    errors = np.array([drive.step(twist)[1] for _ in range(30)])[10:]
    assert np.abs(errors[:, :3].mean(axis=0)).max() < 5e-4
    assert np.abs(errors[:, 3:].mean(axis=0)).max() < 0.01
    assert np.linalg.norm(errors[:, 3:], axis=1).max() < 0.06


def test_a_constant_acceleration_is_followed_without_lag():
    drive, faster = Drive(), np.array([0, 0, 0, 0.2, 0, 0])  # 2 m/s², in the mean speed of each step
    errors = np.array([drive.step(CRUISE + k * faster)[1] for k in range(40)])
    assert abs(errors[15:, 3].mean()) < 0.01


def test_a_turn_is_followed_at_once_only_with_a_gyroscope():
    errors = {}
    for imu in (True, False):
        drive = Drive(imu=imu)
        for _ in range(20):
            drive.step(CRUISE)
        errors[imu] = np.abs(drive.step(BEND)[1][2])
    assert errors[True] < 0.003
    assert errors[False] > 0.03  # the whole rotation of the step


def test_the_gyroscopes_bias_is_estimated():
    bias = np.array([0.01, -0.008, 0.02])
    drive = Drive(gyro_bias=bias)
    early = np.array([drive.step(BEND)[1] for _ in range(3)])
    for _ in range(150):
        drive.step(BEND)
    late = np.array([drive.step(BEND)[1] for _ in range(20)])
    assert np.linalg.norm(late[:, :3].mean(axis=0)) < 0.3 * np.linalg.norm(early[0, :3])
    # in the lidar's axes, as in the filter
    np.testing.assert_allclose(MOUNT[:3, :3] @ drive.filter._filter.x[9:, 0], bias, atol=3e-3)


def test_predictions_scale_with_the_steps_duration():
    drive = Drive()
    for _ in range(20):
        drive.step(BEND)
    for dt_s in (0.05, 0.2, 0.3):
        predicted, error = drive.step(BEND, dt_s)
        assert np.linalg.norm(predicted.pose[:3, 3]) == pytest.approx(15.0 * dt_s, rel=0.02)
        assert np.abs(error[:3]).max() < 3e-3


def test_errors_on_a_car_like_motion_are_within_the_covariance():
    nees = []
    for seed in range(5):
        drive, rng = Drive(), np.random.default_rng(seed)
        drive.rng = rng
        periods = rng.uniform(5.0, 15.0, 2)
        for k in range(60):
            turn, speed = (
                0.2 * np.sin(2 * np.pi * k * 0.1 / periods[0]),
                12 + 3 * np.sin(2 * np.pi * k * 0.1 / periods[1]),
            )
            predicted, error = drive.step(np.array([0, 0, turn, speed, 0, 0]))
            nees.append(error @ np.linalg.solve(predicted.covariance, error) / 6)
    assert 0.2 < np.mean(nees) < 1.3


def test_the_speed_is_unknown_at_the_start():
    predicted, _ = Drive().step(CRUISE)
    np.testing.assert_allclose(predicted.pose[:3, 3], 0.0, atol=1e-12)
    assert 3 * np.sqrt(predicted.covariance[3, 3]) > 4.0


def test_predictions_are_marked_if_the_gyroscope_was_used():
    assert Drive(imu=True).step(CRUISE)[0].from_imu
    assert not Drive(imu=False).step(CRUISE)[0].from_imu


def test_a_correction_before_any_prediction_has_no_effect():
    source = Kalman(Calibration(), NOISE)
    frame = Frame(1, Scan(10**8, np.empty((0, 3), np.float32)))
    source.correct(frame, RelativePose(se3.exp(BEND * 0.1), np.eye(6), "test"))
    state = start_state(0, ImuSamples.empty(), NOISE)
    np.testing.assert_array_equal(source.predict(frame, state).pose, np.eye(4))
