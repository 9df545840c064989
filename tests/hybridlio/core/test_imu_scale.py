"""The matrices that correct an IMU's samples."""

from __future__ import annotations

import numpy as np
import pytest

from hybridlio.core.errors import DataError
from hybridlio.core.imu_scale import ImuScale
from hybridlio.core.sensors import ImuSamples

SAMPLES = ImuSamples(np.arange(3), np.arange(9.0).reshape(3, 3), np.arange(9.0)[::-1].reshape(3, 3))


def random_scale(seed: int) -> ImuScale:
    rng = np.random.default_rng(seed)
    return ImuScale(*(np.eye(3) + rng.uniform(-0.05, 0.05, (3, 3)) for _ in range(2)))


def test_one_scale_after_another_is_their_product():
    first, second = random_scale(1), random_scale(2)
    both = second.after(first).corrected(SAMPLES)
    one_by_one = second.corrected(first.corrected(SAMPLES))
    np.testing.assert_allclose(both.gyro_rad_s, one_by_one.gyro_rad_s)
    np.testing.assert_allclose(both.accel_m_s2, one_by_one.accel_m_s2)


def test_the_identity_changes_nothing():
    assert ImuScale().is_identity
    assert ImuScale().corrected(SAMPLES) is SAMPLES


@pytest.mark.parametrize("matrix", [np.eye(2), np.full((3, 3), np.nan), np.diag([1.0, 1.0, -1.0]), np.eye(3) * 57.3])
def test_what_is_no_scale_of_an_imu_is_refused(matrix: np.ndarray):
    with pytest.raises(DataError, match="imu_scale: accel"):
        ImuScale(accel=matrix)
