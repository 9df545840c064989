from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest
from gps_fixes import SHIFT_S, SIGMA_M, T_enu_world, rmse_m, with_fixes
from gtsam.symbol_shorthand import E, G

from hybridlio.core import se3
from hybridlio.core.errors import DataError, EstimationError
from hybridlio.core.sensors import Calibration, ImuSamples
from hybridlio.core.start_state import start_state
from hybridlio.graph.run.gps_factors import GpsGroup, _plumb_factor
from hybridlio.graph.run.smooth import smooth
from hybridlio.smoothing.gps_options import GpsOptions


@pytest.fixture(scope="module")
def drive(chain: Callable[..., Any]) -> Any:
    return chain(51, steps=240, step_sigmas=np.r_[np.full(3, 3e-3), np.full(3, 0.06)])


@pytest.fixture(scope="module")
def smoothed(drive: Any) -> Any:
    return smooth(with_fixes(drive, 1), gps=True)


def test_fixes_reduce_the_error(drive: Any, smoothed: Any):
    record = with_fixes(drive, 1)
    assert rmse_m(smoothed, drive) < 0.75 * rmse_m(smooth(record), drive)


def test_the_clock_shift_is_found_within_its_claimed_uncertainty(smoothed: Any):
    fit = smoothed.found["gps"]
    assert fit.shift_sigma_s < 0.03
    assert abs(fit.shift_s - SHIFT_S) < 3 * fit.shift_sigma_s


def test_the_frame_of_the_fixes_is_found_within_its_claimed_uncertainty(drive: Any, smoothed: Any):
    fit = smoothed.found["gps"]
    true = T_enu_world(drive) @ drive.calibration.T_imu_lidar
    error = se3.log(se3.between(fit.T_enu_world, true))
    nees = error @ np.linalg.solve(fit.T_enu_world_covariance, error) / 6
    assert nees < 3
    assert np.abs(error[:3]).max() < 0.05


def test_fixes_with_nominal_noise_are_all_used(smoothed: Any):
    fit = smoothed.found["gps"]
    assert fit.rejected.sum() == 0
    assert fit.noise_scale < 1.3
    assert fit.rmse_m == pytest.approx(SIGMA_M * np.sqrt(3), rel=0.25)
    assert "fixes used, 0 rejected" in fit.summary()


WRONG = [4, 11, 12, 20, 29, 37, 43]


@pytest.fixture(scope="module")
def without_wrong(drive: Any) -> Any:
    record = with_fixes(drive, 1)
    return smooth(replace(record, gps=tuple(fix for k, fix in enumerate(record.gps) if k not in WRONG)), gps=True)


@pytest.mark.parametrize("robust", ["cauchy", "geman-mcclure", "gnc"])
def test_wrong_fixes_are_rejected_and_listed(drive: Any, without_wrong: Any, robust: str):
    record = with_fixes(drive, 1)
    rng = np.random.default_rng(2)
    fixes = list(record.gps)
    for k in WRONG:
        fixes[k] = replace(fixes[k], position_m=fixes[k].position_m + rng.uniform(8, 40, 3) * rng.choice([-1, 1], 3))
    bent = smooth(replace(record, gps=tuple(fixes)), gps=GpsOptions(robust=robust))
    assert np.flatnonzero(bent.found["gps"].rejected).tolist() == WRONG
    assert rmse_m(bent, drive) < 1.2 * rmse_m(without_wrong, drive)


def test_an_outage_is_bridged_by_odometry_and_imu(drive: Any, smoothed: Any):
    record = with_fixes(drive, 1)
    start = int(record.online.stamps_ns[0])
    gap = (start + 6_000_000_000, start + 14_000_000_000)
    out = smooth(record, gps=GpsOptions(outages=[gap]))
    fit = out.found["gps"]
    assert (~fit.used).sum() >= 15
    assert (fit.weights[~fit.used] == 0).all()
    assert rmse_m(out, drive) < 2 * rmse_m(smoothed, drive)


def test_overconfident_fixes_are_scaled_to_their_scatter(drive: Any):
    record = with_fixes(drive, 1)
    overconfident = tuple(replace(fix, covariance_m2=fix.covariance_m2 / 100) for fix in record.gps)
    fit = smooth(replace(record, gps=overconfident), gps=True).found["gps"]
    assert fit.noise_scale == pytest.approx(10.0, rel=0.35)
    assert fit.rejected.sum() == 0


def test_fixes_reduce_the_error_without_imu(drive: Any):
    record = with_fixes(drive, 1)
    start = start_state(int(record.online.stamps_ns[0]), ImuSamples.empty(), drive.noise)
    record = replace(record, imu=ImuSamples.empty(), start=start)
    assert rmse_m(smooth(record, gps=True), drive) < 0.75 * rmse_m(smooth(record), drive)


def test_a_known_clock_shift_is_kept(drive: Any):
    record = with_fixes(drive, 1, shift_s=0.0)
    fit = smooth(record, gps=GpsOptions(max_shift_s=0.0)).found["gps"]
    assert abs(fit.shift_s) < 1e-6
    assert fit.shift_sigma_s < 1e-5


def test_too_few_fixes_are_an_error(drive: Any):
    record = with_fixes(drive, 1)
    with pytest.raises(EstimationError, match=r"2 of 2 GPS fixes lie in the run's time; 3 are needed"):
        smooth(replace(record, gps=record.gps[5:7]), gps=True)
    with pytest.raises(EstimationError, match="no GPS fixes in the run's time"):
        smooth(replace(record, gps=()), gps=True)


def test_an_antenna_must_be_three_finite_numbers():
    with pytest.raises(DataError, match="antenna_imu_m"):
        Calibration(antenna_imu_m=np.array([1.0, np.nan, 0.0]))


def test_the_jacobian_of_the_plumb_factor_agrees_with_differences(drive: Any):
    rng = np.random.default_rng(3)
    values = gtsam.Values()
    values.insert(E(0), gtsam.Pose3(se3.exp(rng.normal(size=6))))
    values.insert(G(0), rng.normal(size=3) * 9.0)
    factor = _plumb_factor(drive.start)
    jacobian, _ = factor.linearize(values).jacobian()
    columns = []
    for key, size in ((E(0), 6), (G(0), 3)):
        for step in 1e-6 * np.eye(size):
            moved = []
            for sign in (1, -1):
                delta = gtsam.VectorValues()
                delta.insert(key, sign * step)
                moved.append(-factor.linearize(values.retract(delta)).jacobian()[1])
            columns.append((moved[0] - moved[1]) / 2e-6)
    np.testing.assert_allclose(jacobian, np.column_stack(columns), rtol=1e-4, atol=1e-3)


def test_the_gps_group_can_be_passed_like_any_other_group(drive: Any):
    record = with_fixes(drive, 1)
    assert set(smooth(record, groups=[GpsGroup(record)]).found) == {"gps"}


def test_a_fit_is_doubtful_if_most_fixes_are_rejected_and_its_summary_counts_the_others(drive: Any):
    record = with_fixes(drive, 1, shift_s=0.0)
    fit = smooth(record, gps=GpsOptions(max_shift_s=0.0)).found["gps"]
    assert not fit.is_doubtful
    wrong = fit.used & (np.arange(len(fit.used)) % 5 != 0)
    doubted = replace(fit, weights=np.where(wrong, 0.0, fit.weights))
    assert doubted.is_doubtful
    assert f"{int((fit.used & ~wrong & (fit.weights >= 0.1)).sum())} of {len(fit.used)} fixes used" in doubted.summary()
