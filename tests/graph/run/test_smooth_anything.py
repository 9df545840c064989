"""``smooth`` in one call: odometry of any origin, from files and arrays, with whatever else was measured."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from odometry_files import IMU_LATE_S, write_files
from scipy.spatial.transform import Rotation

import hybridlio as hl
from hybridlio.core.errors import ConfigError, DataError, EstimationError
from hybridlio.core.trajectory import read_tum
from hybridlio.record.inputs import fixes_of, poses_of, record_of
from hybridlio.record.wheel_speeds import WheelSpeeds, read_wheel_speeds


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_files(tmp_path_factory.mktemp("files"))


def rows_of(path: Path) -> np.ndarray:
    return np.loadtxt(path, delimiter=",", skiprows=1)


def test_a_user_with_poses_and_an_imu_gets_a_verdict(files):
    smoothed = hl.smooth(files / "odom.txt", imu=files / "imu.csv", calibration=files / "c.yaml")
    assert smoothed.imu_time_offset_s == pytest.approx(-IMU_LATE_S, abs=0.005)
    text = smoothed.summary()
    assert "IMU clock: stamps moved by" in text
    assert "χ² per component: odometry" in text
    truth = read_tum(files / "truth.txt")
    before, after = (hl.evaluate(one, truth).ate_m for one in (read_tum(files / "odom.txt"), smoothed.trajectory))
    assert after < before


def test_poses_of_every_origin_are_the_same_odometry(files, tmp_path):
    expected = read_tum(files / "odom.txt")
    quaternions = Rotation.from_matrix(expected.poses[:, :3, :3]).as_quat()
    rows = np.column_stack([expected.times_s, expected.poses[:, :3, 3], quaternions])
    euroc = np.column_stack([rows[:, 1:4], quaternions[:, [3, 0, 1, 2]]])
    lines = (f"{t},{','.join(map(repr, row.tolist()))}" for t, row in zip(expected.stamps_ns, euroc, strict=True))
    (tmp_path / "euroc.csv").write_text("\n".join(["#timestamp, p_x, …", *lines]))
    given = (
        expected, files / "odom.txt", str(files / "odom.txt"), rows, tmp_path / "euroc.csv",
    )  # fmt: skip
    for found in (poses_of(one) for one in given):
        np.testing.assert_allclose(found.poses, expected.poses, atol=1e-8)
        np.testing.assert_allclose(found.times_s, expected.times_s, atol=1e-9)
    for source, stamps in ((expected.poses, expected.stamps_ns), (files / "kitti.txt", files / "times.txt")):
        found = poses_of(source, stamps)
        np.testing.assert_allclose(found.poses, expected.poses, atol=1e-6)
        np.testing.assert_array_equal(found.stamps_ns, expected.stamps_ns)


def test_arrays_and_files_give_the_same_result(files):
    of_files = hl.smooth(files / "odom.txt", imu=files / "imu.csv", gps=files / "gps.csv")
    poses = read_tum(files / "odom.txt")
    of_arrays = hl.smooth(poses, imu=rows_of(files / "imu.csv"), gps=rows_of(files / "gps.csv"))
    np.testing.assert_allclose(of_arrays.trajectory.poses, of_files.trajectory.poses, atol=1e-9)
    record = record_of(poses, {"imu": files / "imu.csv", "fixes": files / "gps.csv"})
    again = hl.smooth(record, gps=True)
    np.testing.assert_allclose(again.trajectory.poses, of_files.trajectory.poses, atol=1e-9)


def test_a_runs_folder_is_smoothed_as_its_record(files, tmp_path):
    record = record_of(files / "odom.txt", {})
    record.save(tmp_path / "odometry.npz")
    for path in (tmp_path, str(tmp_path / "odometry.npz")):
        expected = hl.smooth(record).trajectory.poses
        np.testing.assert_allclose(hl.smooth(path).trajectory.poses, expected, atol=1e-9)


def test_wheel_speeds_correct_lengths(files):
    speeds = read_wheel_speeds(files / "wheels.csv")
    truth, poses = read_tum(files / "truth.txt"), read_tum(files / "odom.txt")
    scaled = poses.poses.copy()
    scaled[:, :3, 3] *= 1.02  # odometry that measures 2 % too much
    given = {"calibration": files / "c.yaml", "covariances": np.diag([1e-6] * 3 + [1e-3] * 3)}
    odometry = hl.Trajectory(poses.stamps_ns, scaled)
    alone = hl.smooth(odometry, **given)
    driven = hl.smooth(odometry, wheels=replace(speeds, sigma_m_s=0.02, sideways_sigma_m_s=0.5), **given)
    errors = [abs(one.trajectory.length_m - truth.length_m) / truth.length_m for one in (alone, driven)]
    assert errors[0] > 0.015
    assert errors[1] < 0.005
    fit = driven.found["wheels"]
    assert fit.rmse_m_s < 0.1
    assert fit.weights.min() >= 0
    assert np.isfinite(fit.residuals_m_s).all()
    assert "with speeds" in fit.summary()


def test_velocities_of_three_axes_are_used_without_an_imu(files):
    poses = read_tum(files / "truth.txt")
    speeds = np.gradient(poses.poses[:, :3, 3], poses.times_s, axis=0)
    in_body = (np.swapaxes(poses.poses[:, :3, :3], 1, 2) @ speeds[..., None])[..., 0]
    smoothed = hl.smooth(poses, wheels=WheelSpeeds(poses.stamps_ns, in_body, sigma_m_s=0.05))
    assert smoothed.found["wheels"].rmse_m_s < 0.05
    assert hl.evaluate(smoothed.trajectory, poses).ate_m < 0.1


def test_speeds_that_no_step_has_and_gaps_are_left_out(files):
    poses = read_tum(files / "odom.txt")
    late = WheelSpeeds(poses.stamps_ns + 10**12, np.ones(len(poses)))
    with pytest.raises(EstimationError, match="wheel speeds: none lie in the run's time; check their clock"):
        hl.smooth(poses, wheels=late)
    rows = np.r_[0:100, 150 : len(poses)]
    gappy = read_wheel_speeds(files / "wheels.csv")
    gappy = WheelSpeeds(gappy.stamps_ns[rows], gappy.velocity_m_s[rows])
    fit = hl.smooth(poses, wheels=gappy, calibration=files / "c.yaml").found["wheels"]
    assert np.isnan(fit.residuals_m_s[99:150, 0]).all()
    assert np.isfinite(fit.residuals_m_s[:99, 0]).all()


def test_fixes_may_have_seconds_and_places_on_earth(files, tmp_path):
    (tmp_path / "gps.csv").write_text("t_s,sigma,latitude,longitude,height\n1600000000.123456789,1,49,8,100\n")
    (fix,) = fixes_of(tmp_path / "gps.csv", [])
    assert fix.stamp_ns == 1600000000123456789
    assert fix.origin is not None


def test_what_is_malformed_is_named(files, tmp_path):
    poses = files / "odom.txt"
    with pytest.raises(ConfigError, match="there is no argument 'gyro'; beside poses it takes imu, fixes, calib"):
        hl.smooth(poses, gyro=1)
    with pytest.raises(ConfigError, match="smooth: imu given beside a record, which has its own"):
        hl.smooth(record_of(poses, {}), imu=files / "imu.csv")
    with pytest.raises(DataError, match="imu: expected finite rows t_s, gx"):
        hl.smooth(poses, imu=np.zeros((4, 6)))
    with pytest.raises(DataError, match=r"poses \(N, 4, 4\) have no times"):
        hl.smooth(np.tile(np.eye(4), (3, 1, 1)))
    with pytest.raises(DataError, match=r"poses: expected \(N, 4, 4\) or rows"):
        hl.smooth(np.zeros((3, 5)))
    with pytest.raises(DataError, match="wheels: expected WheelSpeeds or a file, got int"):
        hl.smooth(poses, wheels=3)
    (tmp_path / "w.csv").write_text("t_s,speed\n0,1\n")
    with pytest.raises(DataError, match=r"w.csv: the header must name stamp_ns or t_s, and vx"):
        hl.smooth(poses, wheels=tmp_path / "w.csv")
