from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hybridlio.core import se3
from hybridlio.core.errors import DataError
from hybridlio.core.geodesy import GeodeticPoint, enu_from_geodetic, geodetic_from_enu, origin_of
from hybridlio.core.pose_interpolation import PosePath
from hybridlio.core.sensors import Calibration, GpsFix, ImuSamples
from hybridlio.core.trajectory import Trajectory, read_tum
from hybridlio.datasets.imu_faults import filled_gaps, without_filled_gaps
from hybridlio.record.odometry_noise import odometry_noise
from hybridlio.record.record import Record
from hybridlio.simulation.chain import ChainSettings, make_chain
from hybridlio.smoothing.georeference import MAP, POSES_ENU, TABLE, georeference, write_georeferenced

ORIGIN = GeodeticPoint(48.98, 8.39, 115.0)
ENU = se3.make(Rotation.from_euler("Z", 0.7).as_matrix(), (20.0, -30.0, 2.0))
LEVER = np.array([-0.3, 0.4, 0.9])
SHIFT_S = -0.6


@pytest.fixture(scope="module")
def drive() -> Any:
    return make_chain(77, ChainSettings(steps=300))


@pytest.fixture(scope="module")
def record(drive: Any) -> Record:
    """Fixes without noise, one of them wrong, in a frame that is the drive's levelled, rotated and moved."""
    down = drive.gravity / np.linalg.norm(drive.gravity)
    level, _ = Rotation.align_vectors([[0.0, 0.0, -1.0]], [down])
    T_enu_world = ENU @ se3.make(level.as_matrix(), np.zeros(3))
    plain = drive.record(drive.lidar_poses)
    stamps = plain.online.stamps_ns
    points, _ = PosePath(stamps, drive.poses, drive.velocities).points(stamps[5:-5:7], LEVER)
    places = se3.transform(T_enu_world, points)
    places[9] += 60.0
    at = stamps[5:-5:7] - round(SHIFT_S * 1e9)
    fixes = tuple(GpsFix(int(t), p, 0.01 * np.eye(3), ORIGIN) for t, p in zip(at, places, strict=True))
    mount = Calibration(plain.calibration.T_imu_lidar, antenna_imu_m=LEVER)
    return replace(plain, gps=fixes, calibration=mount)


def test_geodetic_coordinates_convert_to_metres_and_back():
    positions = np.array([[0.0, 0.0, 0.0], [1500.0, -700.0, 30.0]])
    points = geodetic_from_enu(positions, ORIGIN)
    np.testing.assert_allclose(enu_from_geodetic(points, ORIGIN), positions, atol=1e-6)
    np.testing.assert_allclose(origin_of(positions[1], GeodeticPoint(*points[1])), ORIGIN, atol=1e-9)


def test_georeferencing_keeps_the_shape_of_the_run(record: Record):
    placed = georeference(record)
    steps = [se3.between(t.poses[:-1], t.poses[1:]) for t in (placed.trajectory, record.online)]
    np.testing.assert_allclose(steps[0], steps[1], atol=1e-9)


def test_the_alignment_fits_the_fixes_and_finds_shift_and_outlier(record: Record):
    fit = georeference(record).alignment
    assert np.flatnonzero(~fit.inliers).tolist() == [9]
    assert fit.rmse_m < 0.02
    assert fit.shift_s == pytest.approx(SHIFT_S, abs=0.005)


@pytest.mark.parametrize(("most_s", "shift_s"), [(0.01, 0.004), (0.012, -0.008), (0.07, 0.06), (0.12, -0.11)])
def test_a_shift_is_found_within_any_bound(record: Record, most_s: float, shift_s: float):
    later = round((SHIFT_S - shift_s) * 1e9)
    fixes = tuple(replace(fix, stamp_ns=fix.stamp_ns + later) for fix in record.gps)
    fit = georeference(replace(record, gps=fixes), max_shift_s=most_s).alignment
    assert fit.shift_s == pytest.approx(shift_s, abs=0.002)


@pytest.mark.parametrize("apart_s", [18.0, -18.0])
def test_a_shift_of_18_s_between_gps_time_and_utc_is_found_if_the_bound_allows_it(record: Record, apart_s: float):
    fixes = tuple(replace(fix, stamp_ns=fix.stamp_ns + round(apart_s * 1e9)) for fix in record.gps)
    fit = georeference(replace(record, gps=fixes), max_shift_s=20.0).alignment
    assert fit.shift_s == pytest.approx(SHIFT_S - apart_s, abs=0.005)
    assert fit.inliers.sum() == len(fixes) - 1


def test_written_files_contain_the_aligned_poses(record: Record, tmp_path: Path):
    placed = georeference(record)
    assert [path.name for path in write_georeferenced(tmp_path, placed)] == [POSES_ENU, TABLE, MAP]
    np.testing.assert_allclose(read_tum(tmp_path / POSES_ENU).poses, placed.trajectory.poses, atol=1e-9)
    table = np.genfromtxt(tmp_path / TABLE, delimiter=",", names=True)
    enu = np.column_stack([table[name] for name in ("east", "north", "up")])
    geodetic = np.column_stack([table[name] for name in ("latitude", "longitude", "height")])
    np.testing.assert_allclose(enu_from_geodetic(geodetic, ORIGIN), enu, atol=1e-3)
    line = json.loads((tmp_path / MAP).read_text())["features"][0]["geometry"]["coordinates"]
    np.testing.assert_allclose(np.array(line)[:, 1], geodetic[:, 0], atol=1e-9)
    ahead = np.degrees(np.arctan2(*(np.diff(enu[:, :2], axis=0).T))) % 360
    off = (table["heading_deg"][:-1] - ahead + 180) % 360 - 180
    assert np.abs(np.median(off)) < 10  # the lidar is mounted 3 degrees off


def test_without_an_origin_there_are_no_geodetic_coordinates(record: Record, tmp_path: Path):
    local = replace(record, gps=tuple(replace(fix, origin=None) for fix in record.gps))
    placed = georeference(local)
    assert [path.name for path in write_georeferenced(tmp_path, placed)] == [POSES_ENU]
    with pytest.raises(DataError, match="origin on Earth is not known"):
        _ = placed.geodetic
    assert georeference(local, origin=ORIGIN).origin == ORIGIN


def test_a_saved_record_keeps_antenna_and_origin(record: Record, tmp_path: Path):
    record.save(tmp_path / "odometry.npz")
    again = Record.load(tmp_path / "odometry.npz")
    assert again.origin == ORIGIN
    np.testing.assert_array_equal(again.calibration.antenna_imu_m, LEVER)


def test_linearly_filled_gaps_of_samples_are_found_and_removed(record: Record):
    imu = record.imu
    gyro, accel = imu.gyro_rad_s.copy(), imu.accel_m_s2.copy()
    first, last = 500, 650
    share = np.linspace(0, 1, last - first + 1)[:, None]
    for values in (gyro, accel):
        values[first : last + 1] = (1 - share) * values[first] + share * values[last]
    assert filled_gaps(imu) == []
    rest, gaps = without_filled_gaps(ImuSamples(imu.stamps_ns, gyro, accel))
    assert gaps == [(int(imu.stamps_ns[first]), int(imu.stamps_ns[last]))]
    assert len(rest) == len(imu) - (last - first - 1)


@pytest.mark.parametrize("share", [0.05, 0.5])
def test_noise_of_an_odometry_is_estimated_from_the_imu(share: float):
    sigmas = np.r_[np.full(3, 3e-3), np.full(3, 0.05)]
    drive = make_chain(9, ChainSettings(steps=600, step_sigmas=sigmas, drift_share=share, T_imu_lidar=np.eye(4)))
    poses = [np.eye(4)]
    for step in drive.relative:
        poses.append(poses[-1] @ step.pose)
    stamps = np.array([frame.scan.stamp_ns for frame in drive.frames])
    noise = odometry_noise(Trajectory(stamps, np.array(poses)), drive.record(np.array(poses)).imu, drive.calibration)
    assert noise.measured == ("rotation", "translation")
    found = np.sqrt(np.median(np.diagonal(noise.covariances, axis1=1, axis2=2), axis=0))
    np.testing.assert_allclose(found[:3], sigmas[:3], rtol=0.2)
    drift = np.sqrt(np.median(np.diagonal(noise.drifts, axis1=1, axis2=2), axis=0))
    np.testing.assert_allclose(drift[:3], np.sqrt(share) * sigmas[:3], rtol=0.5)


def test_invalid_inputs_of_a_record_are_errors(drive: Any):
    stamps = np.array([frame.scan.stamp_ns for frame in drive.frames])
    with pytest.raises(DataError, match="at least two poses"):
        Record.from_odometry(Trajectory(stamps[:1], np.eye(4)[None]))
    with pytest.raises(DataError, match=r"expected shape \(6, 6\), or \(300, 6, 6\)"):
        Record.from_odometry(Trajectory(stamps, drive.lidar_poses), covariances=np.eye(3))
