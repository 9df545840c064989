"""The contract of every reader of a published data set, on a ride written to its publisher's specification."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import published_data
import pytest

from hybridlio.core.errors import ConfigError, DataError
from hybridlio.datasets import Sequence, open_sequence
from hybridlio.datasets.protection import check_output
from hybridlio.datasets.published.table import PUBLISHED
from hybridlio.datasets.registry import locate

Opened = tuple[published_data.Written, Sequence]


def test_every_published_layout_is_tested_here() -> None:
    assert {*published_data.WRITERS, "tum-rgbd"} == set(PUBLISHED)  # images hold no ride: test_tum_rgbd.py


@pytest.fixture(scope="module", params=list(published_data.WRITERS))
def opened(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Opened:
    if request.param == "argoverse-2":
        pytest.importorskip("pyarrow")
    written = published_data.WRITERS[request.param](tmp_path_factory.mktemp("data"))
    assert locate(written.path)[0] == request.param
    return written, open_sequence(written.path)


def test_a_recording_is_found_from_the_folder_above_it(opened: Opened) -> None:
    written, sequence = opened
    above = written.path.parent
    if above.name in ("LiDAR", "v1.0-mini", "data_3d_raw"):
        above = above.parent
    assert open_sequence(above, sequence=written.path.name).name == sequence.name


def test_stamps_are_those_of_the_ride(opened: Opened) -> None:
    written, sequence = opened
    np.testing.assert_array_equal(sequence.stamps_ns, written.ride.stamps_ns)


def test_scans_hold_the_points_that_were_written(opened: Opened) -> None:
    written, sequence = opened
    for k in (0, 5, 11):
        scan, points = sequence[k].scan, written.ride.points(k)
        np.testing.assert_allclose(scan.points, points[:, :3].astype(np.float32), atol=written.point_error_m)
        assert scan.intensity is not None


def test_times_of_points_span_the_sweep_where_the_publisher_writes_them(opened: Opened) -> None:
    written, sequence = opened
    offsets = sequence[3].scan.time_offsets_ns
    span_s = 0.0 if offsets is None else np.ptp(offsets) / 1e9
    assert span_s == pytest.approx(written.span_s, abs=1e-6)


def test_the_imu_is_on_the_scans_clock_and_in_its_own_frame(opened: Opened) -> None:
    written, sequence = opened
    if not written.has_imu:
        assert not len(sequence.imu)
        assert any("no inertial data" in note for note in sequence.notes)
        return
    expected = written.ride.imu(written.ride.imu_stamps_ns(10))
    R = written.T_ride_imu[:3, :3].T
    np.testing.assert_array_equal(sequence.imu.stamps_ns, expected.stamps_ns)
    np.testing.assert_allclose(sequence.imu.gyro_rad_s, expected.gyro_rad_s @ R.T, atol=1e-9)
    np.testing.assert_allclose(sequence.imu.accel_m_s2, expected.accel_m_s2 @ R.T, atol=1e-9)
    T = written.T_ride_imu @ sequence.calibration.T_imu_lidar
    np.testing.assert_allclose(T, written.ride.T_imu_lidar, atol=1e-6)
    assert not any("specific force points down" in note for note in sequence.notes)


def test_the_reference_is_the_lidar_path_of_the_ride(opened: Opened) -> None:
    written, sequence = opened
    assert sequence.reference is not None
    np.testing.assert_allclose(sequence.reference.poses, written.ride.lidar.poses, atol=1e-6)


def test_a_sequence_can_be_pickled(opened: Opened) -> None:
    _, sequence = opened
    copy = pickle.loads(pickle.dumps(sequence))
    np.testing.assert_array_equal(copy[3].scan.points, sequence[3].scan.points)


def test_recordings_are_not_written_to(opened: Opened) -> None:
    _, sequence = opened
    scan = sequence.load_scan.paths[0]  # type: ignore[attr-defined]
    with pytest.raises(ConfigError, match="recordings are never written to"):
        check_output(scan.parent)


def test_calibration_yaml_overrides_what_is_built_in(tmp_path: Path) -> None:
    written = published_data.write_mulran(tmp_path)
    T = np.eye(4)
    T[0, 3] = 0.5
    (written.path / "calibration.yaml").write_text(f"T_imu_lidar: {T.tolist()}\nimu_time_offset_s: 0.01\n")
    sequence = open_sequence(written.path)
    np.testing.assert_array_equal(sequence.calibration.T_imu_lidar, T)
    assert sequence.imu.stamps_ns[0] == written.ride.imu_stamps_ns(10)[0] + 10_000_000


@pytest.mark.parametrize("sensor", ["Velodyne", "Aeva", "Avia"])
def test_every_sensor_of_helipr_has_its_own_columns(tmp_path: Path, sensor: str) -> None:
    written = published_data.write_helipr(tmp_path)
    kinds = {
        "Velodyne": [("intensity", "<f4"), ("ring", "<u2"), ("t", "<f4")],
        "Aeva": [("r", "<f4"), ("v", "<f4"), ("t", "<i4"), ("line", "u1"), ("intensity", "<f4")],
        "Avia": [("intensity", "u1"), ("tag", "u1"), ("line", "u1"), ("t", "<u4")],
    }[sensor]
    for k, stamp in enumerate(written.ride.stamps_ns + 400_000_000_000_000_000):  # beyond the Aeva's early scans
        offsets = published_data.offsets_ns(50 + k) / (1e9 if sensor == "Velodyne" else 1)
        values = published_data.columns(written.ride, k) | {"t": offsets}
        data = published_data.structured([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), *kinds], values)
        path = tmp_path / f"LiDAR/{sensor}/{stamp}.bin"
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(data)
    sequence = open_sequence(tmp_path, sequence=sensor)
    np.testing.assert_array_equal(sequence[4].scan.points, written.ride.points(4)[:, :3].astype(np.float32))
    assert sequence[4].scan.time_offsets_ns is not None
    assert np.ptp(sequence[4].scan.time_offsets_ns) == pytest.approx(99_000_000, rel=1e-6)
    assert any(f"T_imu_lidar of the {sensor}" in note for note in sequence.notes)
    with pytest.raises(DataError, match="choose a sequence"):
        open_sequence(tmp_path)


@pytest.mark.parametrize("name", ["mulran", "newer-college"])
def test_whole_scans_get_times_from_their_order_and_others_none(tmp_path: Path, name: str) -> None:
    written = published_data.WRITERS[name](tmp_path)
    paths = open_sequence(written.path).load_scan.paths  # type: ignore[attr-defined]
    points = np.random.default_rng(0).uniform(1, 20, (64 * 1024, 4)).astype("<f4")
    columns = dict(zip(("x", "y", "z", "intensity"), points.T, strict=True))
    for path in paths[:-1]:
        path.write_bytes(points.tobytes() if name == "mulran" else published_data.pcd(columns))
    sequence = open_sequence(written.path)
    offsets = sequence[2].scan.time_offsets_ns
    assert offsets is not None
    np.testing.assert_allclose(offsets, np.arange(64 * 1024) // 64 * (1e8 / 1024), atol=1)
    assert sequence[-1].scan.time_offsets_ns is not None
    assert not sequence[-1].scan.time_offsets_ns.any()
