"""Recordings of other origin in KITTI's raw layout: what may be missing or different."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hybridlio.core.errors import DataError
from hybridlio.core.trajectory import Trajectory, write_kitti
from hybridlio.datasets import open_sequence

MS = 1_000_000


def change_rows(recordings: Any, drive: Path, columns: slice | int, value: float) -> None:
    """Write ``value`` into ``columns`` of all rows of the drive."""
    for k, row in enumerate(recordings.ride.oxts_rows(recordings.ride.stamps_ns + 4 * MS)):
        row[columns] = value
        recordings.put(drive / f"oxts/data/{k:010d}.txt", " ".join(f"{v:.14g}" for v in row))


class TestStamps:
    @pytest.mark.parametrize("digits", [1, 2, 3, 6])
    def test_stamps_may_have_fewer_digits(self, recordings: Any, drive: Path, digits: int) -> None:
        path = drive / "velodyne_points/timestamps.txt"
        path.write_text("\n".join(line[: 20 + digits] for line in path.read_text().splitlines()))
        np.testing.assert_allclose(open_sequence(drive).stamps_ns, recordings.ride.stamps_ns, atol=10 ** (9 - digits))

    def test_stamps_of_whole_seconds_are_rejected(self, drive: Path) -> None:
        path = drive / "velodyne_points/timestamps.txt"
        path.write_text("\n".join(line[:19] for line in path.read_text().splitlines()))
        with pytest.raises(DataError, match="more digits"):
            open_sequence(drive)

    def test_stamps_may_be_seconds_some_without_a_point(self, recordings: Any, drive: Path) -> None:
        path = drive / "velodyne_points/timestamps.txt"
        start = recordings.ride.start_ns // 10**9
        path.write_text("\n".join(f"{start + k / 10:.12g}" for k in range(12)) + "\n")
        sequence = open_sequence(drive)
        np.testing.assert_array_equal(sequence.stamps_ns, start * 10**9 + np.arange(12) * 100 * MS)

    def test_stamps_in_microseconds_are_rejected(self, recordings: Any, drive: Path) -> None:
        path = drive / "velodyne_points/timestamps.txt"
        path.write_text("\n".join(str(t // 1000) for t in recordings.ride.stamps_ns))
        with pytest.raises(DataError, match=r"timestamps\.txt: scans are 0\.1 ms apart"):
            open_sequence(drive)

    def test_stamps_of_100_hz_rows_are_not_used_for_scans(self, recordings: Any, drive: Path) -> None:
        (drive / "velodyne_points/timestamps.txt").unlink()
        shutil.rmtree(drive / "oxts")
        recordings.put_oxts(drive / "oxts", recordings.ride, recordings.ride.imu_stamps_ns(10))
        with pytest.raises(DataError, match=r"velodyne_points/timestamps\.txt: no such file"):
            open_sequence(drive)


class TestRows:
    @pytest.mark.parametrize("period_ms", [10, 40])
    def test_there_may_be_more_rows_than_scans(self, recordings: Any, drive: Path, period_ms: int) -> None:
        shutil.rmtree(drive / "oxts")
        shutil.rmtree(drive.with_name("2011_09_30_drive_0016_extract"))
        stamps = recordings.ride.imu_stamps_ns(period_ms)
        recordings.put_oxts(drive / "oxts", recordings.ride, stamps)
        sequence = open_sequence(drive)
        np.testing.assert_array_equal(sequence.imu.stamps_ns, stamps)
        assert sequence.reference is not None
        np.testing.assert_allclose(sequence.reference.poses, recordings.ride.lidar.poses, atol=1e-5)
        assert any("no 100 Hz" in note for note in sequence.notes) == (period_ms == 40)

    @pytest.mark.parametrize("value", [0.0, np.nan])
    def test_rows_without_positions_have_inertial_data_but_no_reference(
        self, recordings: Any, drive: Path, value: float
    ) -> None:
        change_rows(recordings, drive, slice(0, 11), value)
        shutil.rmtree(drive.with_name("2011_09_30_drive_0016_extract"))
        sequence = open_sequence(drive)
        assert len(sequence.imu) == 12
        assert sequence.reference is None
        assert sequence.forward_speed_m_s is None
        assert any("have no positions" in note for note in sequence.notes)

    def test_constant_positions_of_a_moving_vehicle_count_as_missing(self, recordings: Any, drive: Path) -> None:
        change_rows(recordings, drive, slice(0, 2), 49.0)
        sequence = open_sequence(drive)
        assert sequence.reference is None
        np.testing.assert_allclose(sequence.forward_speed_m_s, 8.0)

    def test_a_standing_vehicle_has_a_reference(self, recordings: Any, drive: Path) -> None:
        for k, row in enumerate(recordings.ride.oxts_rows(np.full(12, recordings.ride.start_ns))):
            row[8] = 0.0
            recordings.put(drive / f"oxts/data/{k:010d}.txt", " ".join(f"{v:.14g}" for v in row))
        reference = open_sequence(drive).reference
        assert reference is not None
        np.testing.assert_allclose(reference.poses, np.tile(np.eye(4), (12, 1, 1)), atol=1e-9)

    def test_dataformat_txt_is_not_needed(self, drive: Path) -> None:
        assert not list(drive.rglob("dataformat.txt"))
        (drive / "oxts/dataformat.txt").write_text("lat: latitude\n")
        assert len(open_sequence(drive)) == 12


class TestCalibration:
    def test_the_calibration_may_be_in_the_drive(self, recordings: Any, drive: Path) -> None:
        for path in drive.parent.glob("calib_*.txt"):
            path.rename(drive / path.name)
        calibration = open_sequence(drive).calibration
        np.testing.assert_allclose(calibration.T_imu_lidar, recordings.ride.T_imu_lidar, atol=1e-12)
        assert calibration.T_camera_lidar is not None

    def test_only_the_imu_calibration_is_needed_and_the_error_says_how_to_write_it(self, drive: Path) -> None:
        (drive.parent / "calib_velo_to_cam.txt").unlink()
        assert open_sequence(drive).calibration.T_camera_lidar is None
        (drive.parent / "calib_imu_to_velo.txt").unlink()
        with pytest.raises(
            DataError, match=r"calib_imu_to_velo\.txt: missing.*\n?.*'R:' with 9 numbers and 'T:' with 3"
        ):
            open_sequence(drive)

    def test_the_calibration_is_needed_with_100_hz_data_alone(self, drive: Path) -> None:
        shutil.rmtree(drive / "oxts")
        (drive.parent / "calib_imu_to_velo.txt").unlink()
        with pytest.raises(DataError, match=r"calib_imu_to_velo\.txt"):
            open_sequence(drive)


class TestPoses:
    def exact(self, recordings: Any) -> Trajectory:
        poses = recordings.ride.lidar.poses.copy()
        poses[:, 0, 3] *= 1.01
        return Trajectory(recordings.ride.stamps_ns, poses)

    def test_poses_may_be_beside_the_only_drive_of_a_date(self, recordings: Any, drive: Path) -> None:
        exact = self.exact(recordings)
        write_kitti(drive.parent / "poses.txt", exact)
        reference = open_sequence(drive).reference
        assert reference is not None
        np.testing.assert_allclose(reference.poses, exact.poses, atol=1e-9)
        recordings.write_raw(drive.parents[1], recordings.ride, name="2011_09_30_drive_0018")
        reference = open_sequence(drive).reference
        assert reference is not None
        np.testing.assert_allclose(reference.poses, recordings.ride.lidar.poses, atol=1e-5)

    def test_one_pose_per_scan_suffices_if_scan_numbers_do_not_start_at_0(self, recordings: Any, drive: Path) -> None:
        for k in range(3):
            (drive / f"velodyne_points/data/{k:010d}.bin").unlink()
        exact = self.exact(recordings)
        write_kitti(drive / "poses.txt", Trajectory(exact.stamps_ns[3:], exact.poses[3:]))
        reference = open_sequence(drive).reference
        assert reference is not None
        np.testing.assert_allclose(reference.poses, np.linalg.inv(exact.poses[3]) @ exact.poses[3:], atol=1e-9)

    def test_poses_of_a_camera_are_noted(self, recordings: Any, drive: Path) -> None:
        write_kitti(drive / "poses.txt", self.exact(recordings))
        assert not any("another direction" in note for note in open_sequence(drive).notes)
        write_kitti(drive / "poses.txt", self.exact(recordings), recordings.ride.T_camera_lidar)
        assert any("another direction" in note for note in open_sequence(drive).notes)
