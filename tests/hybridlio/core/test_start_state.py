import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hybridlio.core.errors import DataError
from hybridlio.core.motion_limits import GRAVITY_M_S2
from hybridlio.core.sensors import ImuNoise, ImuSamples
from hybridlio.core.start_state import start_state

NOISE = ImuNoise()


def samples(force: np.ndarray, seconds: float = 0.2) -> ImuSamples:
    stamps = np.arange(0, round(seconds * 1e9) + 1, 10**7)
    return ImuSamples(stamps, np.zeros((len(stamps), 3)), np.tile(force, (len(stamps), 1)))


def tilted(roll_deg: float, pitch_deg: float) -> np.ndarray:
    """Return gravity in the frame of an IMU with this rotation."""
    R = Rotation.from_euler("xyz", [roll_deg, pitch_deg, 0.0], degrees=True)
    return R.inv().apply([0.0, 0.0, -GRAVITY_M_S2])


@pytest.mark.parametrize("angles", [(0, 0), (5, -3), (90, 0), (180, 0), (-30, 60)])
def test_at_rest_gravity_is_opposite_to_the_specific_force(angles: tuple[float, float]):
    gravity = tilted(*angles)
    state = start_state(0, samples(-gravity), NOISE)
    np.testing.assert_allclose(state.gravity_m_s2, gravity, atol=1e-12)
    assert state.has_imu


@pytest.mark.parametrize(
    "acceleration",
    [(2.0, 0.0, 0.0), (-3.0, 0.0, 0.0), (0.0, 3.0, 0.0), (1.5, -2.0, 0.5)],
    ids=["off", "braking", "bend", "all"],
)
def test_under_acceleration_gravitys_error_is_within_its_covariance(acceleration: tuple[float, float, float]):
    gravity = tilted(2.0, -1.0)
    state = start_state(0, samples(np.array(acceleration) - gravity), NOISE)
    off = state.gravity_m_s2 - gravity
    assert np.linalg.norm(off) > 1.0
    assert np.sqrt(off @ np.linalg.solve(state.gravity_covariance, off)) < 3


def test_gravity_has_its_magnitude_whatever_the_specific_force():
    state = start_state(0, samples(np.array([6.0, 0.0, 9.81])), NOISE)
    assert np.linalg.norm(state.gravity_m_s2) == pytest.approx(GRAVITY_M_S2)


def test_noisy_samples_are_averaged(rng: np.random.Generator):
    gravity, stamps = tilted(3.0, 4.0), np.arange(0, 10**9, 10**7)
    force = -gravity + 0.5 * rng.standard_normal((len(stamps), 3))
    state = start_state(0, ImuSamples(stamps, np.zeros((len(stamps), 3)), force), NOISE)
    assert np.linalg.norm(state.gravity_m_s2 - gravity) < 0.2


def test_speed_is_unknown_and_biases_have_the_sensors_uncertainty():
    noise = ImuNoise(gyro_bias_sigma_rad_s=0.03, accel_bias_sigma_m_s2=0.4)
    state = start_state(7, samples(np.array([0.0, 0.0, 9.81])), noise)
    sigmas = np.sqrt(np.diag(state.covariance))
    assert (sigmas[:6] < 1e-5).all()
    assert (sigmas[6:9] >= 15).all()  # 40 m/s, on a motorway, is within 3 σ
    np.testing.assert_allclose(sigmas[9:], np.r_[np.full(3, 0.4), np.full(3, 0.03)])
    for zero in (state.velocity_m_s, state.accel_bias_m_s2, state.gyro_bias_rad_s):
        np.testing.assert_array_equal(zero, 0.0)
    np.testing.assert_array_equal(state.T_world_imu, np.eye(4))
    assert state.stamp_ns == 7


def test_without_samples_the_state_has_no_imu():
    state = start_state(0, ImuSamples.empty(), NOISE)
    assert not state.has_imu
    assert np.isfinite(state.gravity_m_s2).all()


def test_the_covariances_are_positive_definite():
    for imu in (samples(np.array([0.0, 1.0, 9.0])), samples(np.array([0.0, 0.0, 9.81]), 0.0), ImuSamples.empty()):
        state = start_state(0, imu, NOISE)
        np.linalg.cholesky(state.covariance)
        np.linalg.cholesky(state.gravity_covariance)


def test_an_imu_without_an_accelerometer_is_refused():
    with pytest.raises(DataError, match="averages to 0 m/s²"):
        start_state(0, samples(np.zeros(3)), NOISE)
