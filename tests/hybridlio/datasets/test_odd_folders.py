"""Odd but whole folders: they are read rightly, or a note or one line says what is not clear."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.datasets import Sequence, open_sequence

SCANS, POINTS = 6, 3000
GYRO = np.random.default_rng(1).normal(0, 0.2, (70, 3))
FORCE = np.array([0, 0, 9.81]) + np.random.default_rng(2).normal(0, 0.3, (70, 3))
IMU_NS = 10**18 - 50_000_000 + np.arange(70) * 10_000_000
MOUNT = "T_imu_lidar: [[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0.3], [0, 0, 0, 1]]\n"


def points(k: int) -> Array:
    """A smooth wall around the lidar, 8 to 16 m away."""
    across = np.linspace(0, 2 * np.pi, POINTS, endpoint=False)
    up, ranges = np.tile(np.linspace(-0.3, 0.1, 10), POINTS // 10), 12 + 4 * np.sin(3 * across + 0.1 * k)
    directions = [np.cos(across) * np.cos(up), np.sin(across) * np.cos(up), np.sin(up)]
    return np.asarray(ranges * directions).T


def folder(
    root: Path, made: Callable[[int], Array] = points, imu: str = "", calibration: str = MOUNT, more: str = ""
) -> Path:
    """Write scans, the named column of times with them, an IMU's file and a calibration."""
    (root / "scans").mkdir()
    kinds = [(axis, made(0).dtype) for axis in "xyz"] + ([(more, "<i4")] if more else [])
    for k in range(SCANS):
        rows = np.zeros(POINTS, kinds)
        for axis, column in zip("xyz", made(k).T, strict=True):
            rows[axis] = column
        if more:
            rows[more] = np.linspace(0, 99_000_000, POINTS)
        np.save(root / f"scans/{k:06}", rows)
    (root / "timestamps.txt").write_text("".join(f"{10**18 + k * 10**8}\n" for k in range(SCANS)))
    if imu:
        (root / "imu.csv").write_text(imu)
        (root / "calibration.yaml").write_text(calibration)
    return root


def imu_csv(header: str, *columns: Array, separator: str = ",") -> str:
    table = np.hstack(columns)
    lines = [separator.join([str(t), *map(repr, row)]) for t, row in zip(IMU_NS.tolist(), table.tolist(), strict=True)]
    return "\n".join([header.replace(",", separator), *lines]) + "\n"


def noted(sequence: Sequence, text: str) -> bool:
    return any(text in note for note in sequence.notes)


def test_names_of_files_may_have_other_capitals(tmp_path: Path) -> None:
    usual = open_sequence(folder(tmp_path, imu=imu_csv("stamp_ns,gx,gy,gz,ax,ay,az", GYRO, FORCE)))
    for name, other in (
        ("timestamps.txt", "Timestamps.TXT"),
        ("imu.csv", "IMU.csv"),
        ("calibration.yaml", "Calibration.yaml"),
    ):
        (tmp_path / name).rename(tmp_path / other)
    (tmp_path / "scans").rename(tmp_path / "Velodyne Points #1")
    found = open_sequence(tmp_path)
    assert found.stamps_ns.tolist() == usual.stamps_ns.tolist()
    assert found.imu.stamps_ns.tolist() == usual.imu.stamps_ns.tolist()
    assert np.array_equal(found.calibration.T_imu_lidar, usual.calibration.T_imu_lidar)


def test_scans_without_stamps_in_a_folder_of_another_name_are_named(tmp_path: Path) -> None:
    folder(tmp_path)
    (tmp_path / "timestamps.txt").unlink()
    (tmp_path / "scans").rename(tmp_path / "clouds")
    with pytest.raises(DataError, match=r"'clouds' holds scans, but no timestamps\.txt.* give --rate 10"):
        open_sequence(tmp_path)
    (tmp_path / "clouds").rename(tmp_path / "scans")
    assert len(open_sequence(tmp_path, rate_hz=10)) == SCANS


def test_a_smooth_wall_is_not_taken_for_a_code_of_no_return(tmp_path: Path) -> None:
    sequence = open_sequence(folder(tmp_path))
    assert len(sequence[2].scan) == POINTS
    assert not noted(sequence, "points at exactly")


def test_a_code_of_no_return_is_still_left_out(tmp_path: Path) -> None:
    def with_code(k: int) -> Array:
        cloud = points(k)
        cloud[::15] *= (65.535 / np.linalg.norm(cloud[::15], axis=1))[:, None]
        return cloud

    assert len(open_sequence(folder(tmp_path, with_code))[2].scan) == POINTS - POINTS // 15


def test_a_column_that_sounds_like_a_time_is_named(tmp_path: Path) -> None:
    sequence = open_sequence(folder(tmp_path, more="laser_timestamp"))
    assert sequence[1].scan.time_offsets_ns is None
    assert noted(sequence, "'point_times: {column: laser_timestamp}'")


@pytest.mark.parametrize("name", ["relative_time", "delta_t", "utime"])
def test_more_names_of_times_are_known(name: str, tmp_path: Path) -> None:
    offsets = open_sequence(folder(tmp_path, more=name))[1].scan.time_offsets_ns
    assert offsets is not None
    assert (offsets.min(), offsets.max()) == (0, 99_000_000)


def test_whole_centimetres_are_doubted(tmp_path: Path) -> None:
    sequence = open_sequence(folder(tmp_path, lambda k: np.round(100 * points(k)).astype("<i2")))
    assert noted(sequence, "read as millimetres; if they are in another unit")


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda cloud: 60 * cloud, "they are not in metres"),
        (lambda cloud: cloud + np.array([200, 50, 0]), "in a map's frame"),
    ],
)
def test_ranges_of_no_lidar_are_doubted(change: Callable[[Array], Array], text: str, tmp_path: Path) -> None:
    assert noted(open_sequence(folder(tmp_path, lambda k: change(points(k)))), text)


def test_millimetres_that_are_no_whole_numbers_are_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="in millimetres"):
        open_sequence(folder(tmp_path, lambda k: 1000 * points(k)))


@pytest.mark.parametrize("separator", [";", "\t"])
def test_columns_may_be_separated_by_semicolons_or_tabs(separator: str, tmp_path: Path) -> None:
    text = imu_csv("stamp_ns,gx,gy,gz,ax,ay,az", GYRO, FORCE, separator=separator)
    np.testing.assert_array_equal(open_sequence(folder(tmp_path, imu=text)).imu.gyro_rad_s, GYRO)


def test_beside_another_acceleration_the_linear_one_is_that_without_gravity(tmp_path: Path) -> None:
    linear = ",".join(f"linear_acceleration_{axis}" for axis in "xyz")
    for name, header, columns in (
        ("first", f"stamp_ns,gx,gy,gz,{linear},ax,ay,az", (GYRO, FORCE - [0, 0, 9.81], FORCE)),
        ("last", f"stamp_ns,gx,gy,gz,ax,ay,az,{linear}", (GYRO, FORCE, FORCE - [0, 0, 9.81])),
        ("alone", f"stamp_ns,gx,gy,gz,{linear}", (GYRO, FORCE)),
    ):
        (tmp_path / name).mkdir()
        found = open_sequence(folder(tmp_path / name, imu=imu_csv(header, *columns))).imu
        np.testing.assert_array_equal(found.accel_m_s2, FORCE)


def test_two_columns_of_one_rate_are_refused(tmp_path: Path) -> None:
    text = imu_csv("stamp_ns,gyro_x,gyro_y,gyro_z,gx,gy,gz,ax,ay,az", GYRO + 1, GYRO, FORCE)
    with pytest.raises(DataError, match="has gx twice, as 'gyro_x' and 'gx'"):
        open_sequence(folder(tmp_path, imu=text))


@pytest.mark.parametrize(
    ("calibration", "text"),
    [
        ("T_imu_lidar: {translation: [0, 0, 0], roll_pitch_yaw_rad: [0, 0, 90]}\n", "write roll_pitch_yaw_deg"),
        (
            "frames:\n  - {parent: a, child: b, translation: [1, 0, 0], quaternion_xyzw: [0, 0, 0, 1]}\n"
            "  - {parent: b, child: a, translation: [1, 0, 0], quaternion_xyzw: [0, 0, 0, 1]}\n"
            "imu_frame: a\nlidar_frame: b\n",
            "do not connect 'a' and 'b'",
        ),
    ],
)
def test_extrinsics_that_cannot_be_are_refused(calibration: str, text: str, tmp_path: Path) -> None:
    imu = imu_csv("stamp_ns,gx,gy,gz,ax,ay,az", GYRO, FORCE)
    with pytest.raises(DataError, match=text):
        open_sequence(folder(tmp_path, imu=imu, calibration=calibration))
