"""The biases that are assumed of an IMU with nothing stated: those of consumer MEMS parts, not of better ones."""

from __future__ import annotations

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.estimates import RelativePose
from hybridlio.core.sensors import Calibration, Frame, ImuNoise, ImuSamples, Scan
from hybridlio.core.start_state import start_state
from hybridlio.graph.run.fixed_lag_backend import FixedLagBackend
from hybridlio.graph.run.inertial_steps import InertialSteps

ZERO_G_OFFSET = np.array([0.36, -0.2, 0.1])  # m/s²; 43 mg, 1.7 times what BMI088, LSM6DSO and ICM-20948 state per axis
TURN_RAD_S = 1.0  # a bias is told from gravity's direction where the IMU turns
VAGUE_M, OPEN_M = 0.3, 10.0


def squared_error_at_the_end(noise: ImuNoise) -> float:
    """Return the normalised squared error per axis after 3 s in place, of which scans show the first vaguely."""
    backend = FixedLagBackend(InertialSteps(Calibration(), noise))
    step = se3.exp(np.array([0, 0, 0.1 * TURN_RAD_S, 0, 0, 0]))
    for k in range(30):
        stamps = k * 10**8 + np.arange(11) * 10**7
        imu = ImuSamples(
            stamps, np.tile([0.0, 0.0, TURN_RAD_S], (11, 1)), np.tile(ZERO_G_OFFSET + [0.0, 0.0, 9.81], (11, 1))
        )
        if not k:
            backend.start(start_state(0, imu, noise))
        sigma_m = VAGUE_M if k < 10 else OPEN_M
        relative = RelativePose(step, np.diag(np.r_[np.full(3, 1e-3), np.full(3, sigma_m)] ** 2), "test")
        frame = Frame(k + 1, Scan(int(stamps[-1]), np.empty((0, 3), np.float32)), imu, calibration=Calibration())
        estimate = backend.update(frame, relative)
    position, covariance = estimate.T_world_imu[:3, 3], estimate.covariance[3:6, 3:6]
    R = estimate.T_world_imu[:3, :3]
    return float(position @ np.linalg.solve(R @ covariance @ R.T, position) / 3)


def test_an_offset_of_a_consumer_part_does_not_make_positions_run_off_in_silence() -> None:
    assert squared_error_at_the_end(ImuNoise()) < 1.5


@pytest.mark.parametrize("sigma_m_s2", [0.05, 0.1])
def test_a_smaller_assumed_bias_does(sigma_m_s2: float) -> None:
    assert squared_error_at_the_end(ImuNoise(accel_bias_sigma_m_s2=sigma_m_s2)) > 3
