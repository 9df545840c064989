"""KITTI raw drives part by part: scans, calibration and reference, substitutes for what is missing, and bad input."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hybridlio.core.errors import DataError
from hybridlio.datasets import open_sequence
from hybridlio.datasets.kitti.oxts import read_oxts
from hybridlio.datasets.notes import Notes

MS = 1_000_000


def scan_stamps(drive: Path) -> list[str]:
    return (drive / "velodyne_points/timestamps.txt").read_text().splitlines()


def put_scan_stamps(drive: Path, lines: list[str]) -> None:
    (drive / "velodyne_points/timestamps.txt").write_text("\n".join(lines) + "\n")


class TestScans:
    def test_scans_without_stamps_get_those_of_the_navigation_rows(self, recordings: Any, tmp_path: Path) -> None:
        sequence = open_sequence(recordings.write_raw(tmp_path, recordings.ride, own_stamps=False))
        np.testing.assert_array_equal(sequence.stamps_ns, recordings.ride.stamps_ns + 4 * MS)
        assert any("stamps of the navigation rows" in note for note in sequence.notes)

    def test_with_missing_scans_the_others_keep_stamps_and_reference_poses(self, recordings: Any, drive: Path) -> None:
        for k in (5, 6):
            (drive / f"velodyne_points/data/{k:010d}.bin").unlink()
        sequence, present = open_sequence(drive), [0, 1, 2, 3, 4, 7, 8, 9, 10, 11]
        np.testing.assert_array_equal(sequence.stamps_ns, recordings.ride.stamps_ns[present])
        assert any("scans: 1 gap, the longest 0.300 s after row 4" in note for note in sequence.notes)
        assert any("2 scans are missing" in note and "number 5" in note for note in sequence.notes)
        assert sequence.reference is not None
        np.testing.assert_allclose(sequence.reference.poses, recordings.ride.lidar.poses[present], atol=1e-5)
        np.testing.assert_array_equal(sequence[5].scan.points, recordings.ride.points(7)[:, :3].astype(np.float32))

    def test_a_missing_scan_may_have_a_blank_stamp(self, drive: Path) -> None:
        lines = scan_stamps(drive)
        put_scan_stamps(drive, [*lines[:5], "", *lines[6:]])
        with pytest.raises(DataError, match="do not cover"):
            open_sequence(drive)
        (drive / "velodyne_points/data/0000000005.bin").unlink()
        assert len(open_sequence(drive)) == 11

    def test_scans_with_wrong_stamps_are_dropped_one_scan_per_stamp(self, recordings: Any, drive: Path) -> None:
        lines = scan_stamps(drive)
        lines[4] = lines[3]
        lines[7] = recordings.iso(recordings.ride.start_ns + 10**12)
        put_scan_stamps(drive, lines)
        sequence = open_sequence(drive)
        assert len(sequence) == 10
        assert set(sequence.stamps_ns.tolist()) <= set(recordings.ride.stamps_ns.tolist())
        assert any("dropped 2 scans" in note for note in sequence.notes)

    def test_too_few_stamps_are_rejected(self, drive: Path) -> None:
        put_scan_stamps(drive, scan_stamps(drive)[:-1])
        with pytest.raises(DataError, match=r"0000000011\.bin"):
            open_sequence(drive)

    def test_the_error_names_file_and_line_of_an_unreadable_stamp(self, drive: Path) -> None:
        lines = scan_stamps(drive)
        lines[2] = "2011-09-30 12:00:0"
        put_scan_stamps(drive, lines)
        with pytest.raises(DataError, match=r"timestamps\.txt, line 3"):
            open_sequence(drive)

    @pytest.mark.parametrize("data", [b"", np.full((9, 4), np.nan, "<f4").tobytes()], ids=["empty", "not finite"])
    def test_the_error_names_the_frame_of_a_scan_without_points(self, drive: Path, data: bytes) -> None:
        (drive / "velodyne_points/data/0000000004.bin").write_bytes(data)
        with pytest.raises(DataError, match=r"frame 4: .*0000000004\.bin"):
            open_sequence(drive)[4]

    def test_points_that_are_not_finite_are_left_out(self, recordings: Any, drive: Path) -> None:
        points = recordings.ride.points(2)
        points[[3, 8], [0, 2]] = np.nan, np.inf
        recordings.put_bin(drive / "velodyne_points/data/0000000002.bin", points)
        assert len(open_sequence(drive)[2].scan) == len(points) - 2


class TestCalibration:
    def test_a_drive_with_inertial_data_needs_the_imu_calibration(self, drive: Path) -> None:
        (drive.parent / "calib_imu_to_velo.txt").unlink()
        with pytest.raises(DataError, match=r"calib_imu_to_velo\.txt"):
            open_sequence(drive)

    @pytest.mark.parametrize("content", ["", "R: 1 0 0 0 1 0 0 0 1\n", "R: 1 2 3\nT: 0 0 0\n", "R: 1\nT: nan 0 0"])
    def test_a_malformed_file_is_named_in_the_error(self, drive: Path, content: str) -> None:
        (drive.parent / "calib_imu_to_velo.txt").write_text(content)
        with pytest.raises(DataError, match=r"calib_imu_to_velo\.txt"):
            open_sequence(drive)

    def test_the_camera_frame_is_rectified_if_the_rotation_is_known(self, recordings: Any, drive: Path) -> None:
        plain = open_sequence(drive).calibration.T_camera_lidar
        assert plain is not None
        np.testing.assert_allclose(plain, recordings.ride.T_camera_lidar, atol=1e-12)
        quarter = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
        (drive.parent / "calib_cam_to_cam.txt").write_text("R_rect_00: " + " ".join(map(str, quarter.ravel())))
        rectified = open_sequence(drive).calibration.T_camera_lidar
        assert rectified is not None
        np.testing.assert_allclose(rectified[:3], quarter @ plain[:3], atol=1e-12)


class TestReference:
    def test_scans_outside_the_navigation_rows_have_no_reference(self, drive: Path) -> None:
        for k in range(5, 12):
            (drive / f"oxts/data/{k:010d}.txt").unlink()
        sequence = open_sequence(drive)
        assert sequence.reference is None
        assert any("no reference poses: scan 11" in note for note in sequence.notes)

    def test_the_forward_speed_equals_that_of_the_ride(self, drive: Path) -> None:
        np.testing.assert_allclose(open_sequence(drive).forward_speed_m_s, np.full(12, 8.0))

    def test_the_projection_agrees_with_geodesy(self, drive: Path) -> None:
        pymap3d = pytest.importorskip("pymap3d")
        rows = read_oxts(drive / "oxts", Notes("drive"))
        lat, lon, alt = rows.values[:, :3].T
        enu = np.column_stack(pymap3d.geodetic2enu(lat, lon, alt, lat[0], lon[0], alt[0]))
        # KITTI's projection takes the earth as a sphere: up to 0.4 % off at this latitude
        np.testing.assert_allclose(rows.T_enu_imu[:, :3, 3], enu, rtol=0.004, atol=1e-4)
