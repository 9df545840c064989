"""The gyroscope's unknown scale in the covariance of preintegration, against gyroscopes of wrong scales."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from inertial import samples, state_at, tumbling

from hybridlio.core import se3
from hybridlio.core.sensors import ImuNoise
from hybridlio.graph.base.preintegration import predict_in_parts, with_scale_error

CONSUMER_GYRO = ImuNoise(gyro_scale_sigma=ImuNoise().gyro_scale_sigma)


@pytest.mark.parametrize("turns", [0.2, 0.45, 2.0])
def test_the_covariance_covers_a_gyroscope_of_a_consumer_imu(turns: float, rng: np.random.Generator):
    """Sensitivities off by their tolerance of 1.5 %, axes mixed by up to 1 %, and no other error (ICM-20948)."""
    imu, R_end = tumbling(turns)
    state, nees = state_at(np.eye(4), np.zeros(3)), []
    for _ in range(60):
        off = np.diag(0.015 * rng.choice([-1.0, 1.0], 3)) + rng.uniform(-0.01, 0.01, (3, 3)) * (1 - np.eye(3))
        wrong = replace(imu, gyro_rad_s=imu.gyro_rad_s @ (np.eye(3) + off).T)
        step, covariance = predict_in_parts(wrong, state, CONSUMER_GYRO)
        error = se3.log(se3.between(step, se3.make(R_end.as_matrix(), np.zeros(3))))[:3]
        nees.append(error @ np.linalg.solve(covariance[:3, :3], error) / 3)
    assert 0.3 < np.mean(nees) < 3.0


def test_a_motion_to_and_fro_takes_the_error_of_scale_back():
    times = np.arange(2001) / 200
    swinging = samples(times, np.outer(np.cos(2 * np.pi * times), [0.0, 0.0, 0.5]), np.zeros((2001, 3)))
    turning = samples(times, np.tile([0.0, 0.0, 0.5], (2001, 1)), np.zeros((2001, 3)))
    state = state_at(np.eye(4), np.zeros(3))
    added = [
        np.sqrt(10.0 * (with_scale_error(CONSUMER_GYRO, imu, state).gyro_rad_s_sqrt_hz ** 2 - 1e-3**2))
        for imu in (swinging, turning)
    ]
    np.testing.assert_allclose(added, CONSUMER_GYRO.gyro_scale_sigma * np.array([0.5 / (2 * np.pi), 5.0]), rtol=0.01)
