"""Estimating the lag of angular rates: on motion in closed form, and on real drives."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hybridlio.core.arrays import Array
from hybridlio.datasets.kitti.gyro_lag import gyro_lag_ns
from hybridlio.datasets.stamps import read_stamps

MS = 1_000_000
START_NS = 1_317_042_272_000_000_000


def attitude(seconds: Array, size: float = 1.0) -> Array:
    """Return roll, pitch and yaw ``(N, 3)``: a car that sways at 0.9 and 1.3 Hz and turns within 12 s."""
    roll, pitch = 0.01 * np.sin(2 * np.pi * 0.9 * seconds), 0.008 * np.cos(2 * np.pi * 1.3 * seconds)
    return size * np.column_stack([roll, pitch, 0.6 * np.sin(2 * np.pi * seconds / 12)])


def rate(seconds: Array, size: float = 1.0) -> Array:
    """Return the body angular velocity ``(N, 3)`` of :func:`attitude`, by central differences."""
    half = 1e-4
    before, after = (Rotation.from_euler("ZYX", attitude(seconds + d, size)[:, ::-1]) for d in (-half, half))
    return np.asarray((before.inv() * after).as_rotvec() / (2 * half))


class Rows:
    """Rows of a drive whose rates lag by ``lag_ms``, with a bias and optional noise."""

    def __init__(self, period_ms: int, lag_ms: float, length_s: float = 20, noise: float = 0.0, size: float = 1.0):
        rng = np.random.default_rng(4)
        self.stamps_ns = START_NS + np.arange(0, round(length_s * 1000), period_ms) * MS
        seconds = (self.stamps_ns - START_NS) / 1e9
        self.attitude = attitude(seconds, size) + rng.normal(0, noise * 1e-4, (len(seconds), 3))
        gyro = rate(seconds - lag_ms / 1e3, size) + np.array([0.01, -0.005, 0.02])
        self.gyro = gyro + rng.normal(0, noise * 2e-3, gyro.shape)

    @property
    def lag_ms(self) -> float:
        return gyro_lag_ns(self.stamps_ns, self.attitude, self.gyro) / MS


@pytest.mark.parametrize("period_ms", [10, 100])
@pytest.mark.parametrize("lag_ms", [30, 56, 90])
@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_a_lag_is_estimated(period_ms: int, lag_ms: float, noise: float) -> None:
    assert Rows(period_ms, lag_ms, noise=noise).lag_ms == pytest.approx(lag_ms, abs=2 + 4 * noise)


@pytest.mark.parametrize("period_ms", [10, 100])
@pytest.mark.parametrize("noise", [0.0, 1.0, 10.0])
def test_rates_without_lag_give_zero(period_ms: int, noise: float) -> None:
    assert Rows(period_ms, 0, noise=noise).lag_ms == 0


@pytest.mark.parametrize("period_ms", [10, 100])
def test_negative_or_too_long_lags_give_zero(period_ms: int) -> None:
    for lag_ms in (-40, 250):
        assert Rows(period_ms, lag_ms).lag_ms == 0


@pytest.mark.parametrize("period_ms", [10, 100])
def test_too_little_rotation_or_too_few_rows_give_zero(period_ms: int) -> None:
    assert Rows(period_ms, 56, noise=1.0, size=0.01).lag_ms == 0
    assert Rows(period_ms, 56, length_s=1.2).lag_ms == 0
    assert Rows(period_ms, 56, length_s=2 * period_ms / 1e3).lag_ms == 0


@pytest.mark.parametrize("period_ms", [10, 100])
def test_rates_with_wrong_axes_signs_or_units_give_zero(period_ms: int) -> None:
    for wrong in (np.diag([1.0, -1, -1]), np.roll(np.eye(3), 1, axis=0), np.degrees(np.eye(3))):
        rows = Rows(period_ms, 56)
        rows.gyro = rows.gyro @ wrong.T
        assert rows.lag_ms == 0


@pytest.mark.parametrize("constant", [0.0, 0.3])
def test_missing_attitudes_give_zero(constant: float) -> None:
    rows = Rows(100, 56)
    rows.attitude[:] = constant
    assert rows.lag_ms == 0


@pytest.mark.parametrize("period_ms", [10, 100])
def test_gaps_jitter_and_attitude_jumps_do_not_change_the_lag(period_ms: int) -> None:
    rows = Rows(period_ms, 56, length_s=40)
    rng = np.random.default_rng(5)
    seconds = (rows.stamps_ns - START_NS) / 1e9 + rng.uniform(-0.3, 0.3, len(rows.stamps_ns)) * period_ms / 1e3
    keep = (seconds < 11) | (seconds > 13.3)
    rows.stamps_ns, rows.attitude, rows.gyro = (
        START_NS + (seconds[keep] * 1e9).astype(np.int64), attitude(seconds)[keep], rate(seconds - 0.056)[keep]
    )  # fmt: skip
    rows.attitude[len(rows.attitude) // 3 :, 2] += 0.1
    assert rows.lag_ms == pytest.approx(56, abs=3)


def test_long_recordings_are_estimated_quickly() -> None:
    for period_ms, length_s in ((100, 3600), (10, 900)):
        rows = Rows(period_ms, 56, length_s=length_s, noise=1.0)
        start = time.process_time()
        assert rows.lag_ms == pytest.approx(56, abs=3)
        assert time.process_time() - start < 2


@pytest.mark.parametrize("date", ["2011_09_26", "2011_09_28", "2011_09_29", "2011_09_30", "2011_10_03"])
def test_real_rates_lag_by_about_56_ms_on_all_dates_and_standing_drives_give_zero(shared_data: Path, date: str) -> None:
    stand = ("2011_09_28_drive_0016", "2011_09_28_drive_0021", "2011_09_28_drive_0039")
    drives = sorted((shared_data / "kitti_oxts").glob(f"{date}_drive_*"))[-3:]
    assert drives
    for drive in drives:
        values = np.loadtxt(drive / "oxts.txt")
        stamps, first = np.unique(read_stamps(drive / "timestamps.txt"), return_index=True)
        lag_ms = gyro_lag_ns(stamps, values[first, 3:6], values[first, 17:20]) / MS
        assert lag_ms == 0 if drive.name in stand else 45 < lag_ms < 65, drive.name
