"""The simulated IMU: consistency with the path, and its errors."""

import numpy as np
import pytest
from integration import integrate
from scipy.spatial.transform import Rotation

from hybridlio.core.sensors import ImuNoise
from hybridlio.simulation.config import SimulationConfig
from hybridlio.simulation.plan import plan
from hybridlio.simulation.sensors.imu import add_noise, ideal_imu

SILENT = ImuNoise(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    "settings",
    [{"seed": 1}, {"seed": 2, "speed_m_s": 20.0}, {"seed": 3, "scene": "field"}, {"seed": 4, "start_moving": False}],
    ids=["town", "fast", "field", "from rest"],
)
def test_integrating_the_ideal_imu_reproduces_the_path(settings: dict):
    path = plan(SimulationConfig(seconds=12.0, **settings)).path
    times = 1.0 + np.arange(1001) / 100
    motion = path.motion(times)
    truth = Rotation.from_matrix(motion.poses[:, :3, :3])
    start = (truth[0], motion.poses[0, :3, 3], motion.velocity_m_s[0])
    attitude, position = integrate(times, *ideal_imu(path, times), *start)
    assert np.linalg.norm(position - motion.poses[:, :3, 3], axis=1).max() < 1e-3
    assert np.degrees((attitude.inv() * truth).magnitude()).max() < 1e-3


def test_an_imu_at_rest_measures_gravity_and_no_rotation():
    path = plan(SimulationConfig(seconds=5.0, seed=4, start_moving=False)).path
    gyro, accel = ideal_imu(path, np.arange(0.0, 1.0, 0.01))
    np.testing.assert_allclose(np.linalg.norm(accel, axis=1), 9.81, atol=1e-3)
    assert accel[:, 2].min() > 9.6
    assert np.abs(gyro).max() < 1e-3


def test_zero_noise_changes_nothing(rng: np.random.Generator):
    gyro, accel = rng.normal(size=(2, 50, 3))
    noisy = add_noise(gyro, accel, SILENT, 100.0, rng)
    np.testing.assert_array_equal(noisy[0], gyro)
    np.testing.assert_array_equal(noisy[1], accel)


def test_white_noise_has_its_density_at_any_rate(rng: np.random.Generator):
    noise = ImuNoise(2e-3, 3e-2, 0.0, 0.0, 0.0, 0.0)
    for rate in (100.0, 400.0):
        gyro, accel = add_noise(np.zeros((40000, 3)), np.zeros((40000, 3)), noise, rate, rng)
        assert gyro.std() == pytest.approx(2e-3 * np.sqrt(rate), rel=0.02)
        assert accel.std() == pytest.approx(3e-2 * np.sqrt(rate), rel=0.02)


def test_a_bias_walk_grows_with_the_square_root_of_time(rng: np.random.Generator):
    noise = ImuNoise(0.0, 0.0, 1e-4, 5e-3, 0.0, 0.0)
    seconds, rate = 10.0, 100.0
    runs = [add_noise(*np.zeros((2, int(seconds * rate), 3)), noise, rate, rng) for _ in range(400)]
    ends = np.array([(gyro[-1], accel[-1]) for gyro, accel in runs])
    assert ends[:, 0].std() == pytest.approx(1e-4 * np.sqrt(seconds), rel=0.08)
    assert ends[:, 1].std() == pytest.approx(5e-3 * np.sqrt(seconds), rel=0.08)


def test_the_initial_bias_has_its_standard_deviation(rng: np.random.Generator):
    noise = ImuNoise(0.0, 0.0, 0.0, 0.0, 0.01, 0.1)
    runs = np.array([add_noise(*np.zeros((2, 4, 3)), noise, 100.0, rng) for _ in range(600)])
    np.testing.assert_array_equal(runs[:, :, 0], runs[:, :, -1])
    assert runs[:, 0].std() == pytest.approx(0.01, rel=0.08)
    assert runs[:, 1].std() == pytest.approx(0.1, rel=0.08)
