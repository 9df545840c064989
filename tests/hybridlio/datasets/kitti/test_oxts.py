"""KITTI's navigation rows: shifting lagging angular rates, in closed form and on real rows."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from hybridlio.core import se3
from hybridlio.core.sensors import ImuSamples
from hybridlio.datasets.kitti.oxts import OxtsRows, read_oxts
from hybridlio.datasets.notes import Notes

START_NS = 1_317_042_272_000_000_000
MS = 1_000_000


def rate(seconds: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return an angular velocity ``(N, 3)`` that oscillates at up to 1.2 Hz."""
    return np.column_stack([0.1 * np.sin(7 * seconds), 0.05 * np.cos(5 * seconds), 0.3 * np.sin(3 * seconds)])


def force(seconds: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.column_stack([np.sin(2 * seconds), np.cos(seconds), 9.81 + 0.2 * np.sin(6 * seconds)])


def rows(period_ms: int, lag_ns: int) -> OxtsRows:
    stamps = START_NS + np.arange(0, 6000, period_ms) * MS
    seconds, values = (stamps - START_NS) / 1e9, np.zeros((len(stamps), 30))
    values[:, 11:14], values[:, 17:20] = force(seconds), rate(seconds - lag_ns / 1e9)
    return OxtsRows(stamps, values)


def turned(imu: ImuSamples) -> NDArray[np.float64]:
    """Integrate the samples to a rotation ``(3, 3)``."""
    R = np.eye(3)
    steps = np.diff(imu.stamps_ns)[:, None] / 1e9 * (imu.gyro_rad_s[1:] + imu.gyro_rad_s[:-1]) / 2
    for step in se3.so3_exp(steps):
        R = R @ step
    return R


@pytest.mark.parametrize("period_ms", [10, 100])
def test_late_rates_are_shifted_to_their_time(period_ms: int) -> None:
    lag_ns = 56 * MS
    imu = rows(period_ms, lag_ns).imu(lag_ns)
    seconds = (imu.stamps_ns - START_NS) / 1e9
    known = imu.stamps_ns <= START_NS + 5900 * MS - lag_ns
    # linear interpolation is off by an eighth of the step squared times the second derivative: 4.9 and 7.2 at most
    eighth = (period_ms / 1e3) ** 2 / 8
    np.testing.assert_allclose(imu.gyro_rad_s[known], rate(seconds)[known], rtol=0, atol=4.9 * eighth)
    np.testing.assert_allclose(imu.accel_m_s2, force(seconds), rtol=0, atol=7.2 * eighth)


def test_slow_rows_keep_every_sample_of_both_sensors() -> None:
    lag_ns = 56 * MS
    slow = rows(100, lag_ns)
    imu = slow.imu(lag_ns)
    at_rows, at_rates = np.isin(imu.stamps_ns, slow.stamps_ns), np.isin(imu.stamps_ns, slow.stamps_ns - lag_ns)
    np.testing.assert_array_equal(imu.accel_m_s2[at_rows], slow.values[:, 11:14])
    np.testing.assert_allclose(imu.gyro_rad_s[at_rates], slow.values[1:, 17:20], atol=1e-15)


def test_without_a_lag_the_rows_are_unchanged() -> None:
    for period_ms in (10, 100):
        plain = rows(period_ms, 0)
        imu = plain.imu(0)
        np.testing.assert_array_equal(imu.stamps_ns, plain.stamps_ns)
        np.testing.assert_array_equal(imu.gyro_rad_s, plain.values[:, 17:20])
        np.testing.assert_array_equal(imu.accel_m_s2, plain.values[:, 11:14])


def test_shifted_real_rates_agree_with_the_attitudes(kitti_raw_root: Path) -> None:
    real = read_oxts(kitti_raw_root / "2011_09_26/2011_09_26_drive_0005_sync/oxts", Notes("drive"))
    R = real.T_enu_imu[:, :3, :3]

    def error(lag_ns: int) -> NDArray[np.float64]:
        imu, stamps = real.imu(lag_ns), real.stamps_ns.tolist()
        parts = [turned(imu.between(a, b)) for a, b in pairwise(stamps[1:-2])]
        true = np.swapaxes(R[1:-3], 1, 2) @ R[2:-2]
        return np.asarray(se3.so3_log(np.swapaxes(np.array(parts), 1, 2) @ true).std(axis=0))

    assert 45 * MS < real.gyro_lag_ns < 65 * MS
    assert (error(real.gyro_lag_ns) < 0.6 * error(0)).all()
