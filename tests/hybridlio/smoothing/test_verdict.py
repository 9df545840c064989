"""The verdict on a smoothing, by itself and on a drive."""

import json

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.sensors import ImuSamples
from hybridlio.core.trajectory import Trajectory
from hybridlio.graph.run.smooth import smooth
from hybridlio.record.record import Record
from hybridlio.smoothing.verdict import IMU, ODOMETRY, KindFit, Verdict


def fit(kind: str, ratio: float) -> KindFit:
    return KindFit.of(kind, [(f"scan {k}", 6 * ratio * (2 if k == 7 else 1), 6) for k in range(1, 20)])


def test_a_good_fit_has_no_doubts():
    verdict = Verdict.of([fit(ODOMETRY, 0.5), fit(IMU, 0.5), KindFit.of("gps", [])])
    assert verdict.doubts == ()
    assert not verdict.refused
    assert verdict.summary() == "χ² per component: odometry 0.53 (19 measurements), IMU 0.53 (19 measurements)"
    assert json.loads(json.dumps(verdict.to_json_dict()))["kinds"]["IMU"]["measurements"] == 19


def test_a_bad_kind_is_doubtful_with_its_worst_measurements_and_the_usual_cause():
    (doubt,) = Verdict.of([fit(ODOMETRY, 0.5), fit("gps", 3.0)]).doubts
    assert doubt.startswith("gps: χ² per component is 3.2; worst: scan 7 (6), ")
    assert "antenna" in doubt


def test_only_an_imu_against_the_odometry_is_refused():
    assert Verdict.of([fit(ODOMETRY, 10.0), fit(IMU, 1.0)]).refused
    assert Verdict.of([fit(ODOMETRY, 1.2), fit(IMU, 10.0)]).refused
    assert not Verdict.of([fit(ODOMETRY, 0.5), fit(IMU, 10.0)]).refused  # the solution stays at the odometry
    assert not Verdict.of([fit(ODOMETRY, 1.2), fit(IMU, 1.0)]).refused
    assert not Verdict.of([fit(ODOMETRY, 10.0), fit(IMU, 1.0), fit("gps", 1.0)]).refused
    assert not Verdict.of([fit(ODOMETRY, 10.0)]).refused


def test_the_variance_factor_is_chi2_per_degree_of_freedom():
    """Of odometry and IMU: each step with samples has 27 components and 21 variables."""
    steps = [KindFit.of(ODOMETRY, [("scan 1", 3.0, 12)] * 20), KindFit.of(IMU, [("scan 1", 3.0, 15)] * 20)]
    assert Verdict.of(steps).variance_factor == pytest.approx(1.0)
    assert Verdict.of([fit(ODOMETRY, 5.0)]).variance_factor == 1.0


@pytest.fixture(scope="module")
def drive() -> tuple[Trajectory, ImuSamples]:
    """An odometry without errors, and samples of the same motion: a vehicle on a winding road."""
    stamps = np.arange(0, 8_000_000_001, 10_000_000)
    times = stamps / 1e9
    yaw = 0.6 * np.sin(1.3 * times)
    rates = np.column_stack([0 * times, 0 * times, np.gradient(yaw, times)])
    R = se3.so3_exp(np.column_stack([0 * times, 0 * times, yaw]))
    velocity = 8 * R[:, :, 0]
    steps = (velocity[1:] + velocity[:-1]) / 2 * 0.01
    positions = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
    force = (np.swapaxes(R, 1, 2) @ (np.gradient(velocity, times, axis=0) + np.array([0, 0, 9.81]))[..., None])[..., 0]
    poses = se3.make(R, positions)
    return Trajectory(stamps[::10], se3.between(poses[0], poses[::10])), ImuSamples(stamps, rates, force)


def test_smoothing_with_a_right_imu_fits(drive: tuple[Trajectory, ImuSamples]):
    record = Record.from_odometry(*drive, covariances=np.diag([1e-6] * 3 + [1e-4] * 3), imu_time_offset_s=0.0)
    smoothed = smooth(record)
    assert [kind.kind for kind in smoothed.verdict.kinds] == [ODOMETRY, IMU]
    assert smoothed.verdict.doubts == ()


def test_an_imu_that_contradicts_the_odometry_does_not_replace_it(drive: tuple[Trajectory, ImuSamples]):
    trajectory, imu = drive
    late = ImuSamples(imu.stamps_ns + 500_000_000, imu.gyro_rad_s, imu.accel_m_s2)
    record = Record.from_odometry(trajectory, late, covariances=np.diag([1e-8] * 3 + [1e-6] * 3), imu_time_offset_s=0.0)
    smoothed = smooth(record)
    assert smoothed.verdict.refused
    assert "contradicts its own odometry" in smoothed.verdict.doubts[0]
    np.testing.assert_array_equal(smoothed.trajectory.poses, record.online.poses)
    assert smoothed.step_covariances.shape == (len(trajectory) - 1, 6, 6)
