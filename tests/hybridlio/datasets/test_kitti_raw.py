"""KITTI raw drives: substitutes for what is missing, what the simulator adds, and bad input."""

from __future__ import annotations

import json
import logging
import shutil
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import trapezoid

from hybridlio.datasets import open_sequence
from hybridlio.datasets.kitti_raw import find
from hybridlio.datasets.oxts import read_oxts
from hybridlio.datasets.sequence import Notes
from hybridlio.errors import DataError
from hybridlio.sensors import LIDAR_MODELS, ImuNoise, ImuSamples
from hybridlio.trajectory import Trajectory
from hybridlio.trajectory_files import write_kitti

MS = 1_000_000


@pytest.fixture
def drive(recordings: Any, tmp_path: Path) -> Path:
    """A drive with its 100 Hz recording beside it."""
    return recordings.write_raw(tmp_path, recordings.ride)


def scan_stamps(drive: Path) -> list[str]:
    return (drive / "velodyne_points/timestamps.txt").read_text().splitlines()


def put_scan_stamps(drive: Path, lines: list[str]) -> None:
    (drive / "velodyne_points/timestamps.txt").write_text("\n".join(lines) + "\n")


class TestFinding:
    def test_the_drive_opens_from_its_folder_its_date_its_root_and_from_inside(self, drive: Path) -> None:
        for path in (drive, drive.parent, drive.parents[1], drive / "velodyne_points", drive / "velodyne_points/data"):
            assert open_sequence(path).name == "2011_09_30_drive_0016"

    def test_one_of_several_is_picked_by_name_or_number(self, recordings: Any, drive: Path) -> None:
        root = drive.parents[1]
        recordings.write_raw(root, recordings.ride, name="2011_10_03_drive_0027")
        for wanted in ("2011_10_03_drive_0027", "2011_10_03_drive_0027_sync", "0027", "27"):
            assert open_sequence(root, sequence=wanted).name == "2011_10_03_drive_0027"

    def test_several_without_a_choice_and_a_choice_that_fits_several_list_the_names(
        self, recordings: Any, drive: Path
    ) -> None:
        root = drive.parents[1]
        recordings.write_raw(root, recordings.ride, name="2011_10_03_drive_0016")
        for wanted in (None, "0016", "0099"):
            with pytest.raises(DataError, match=r"2011_09_30_drive_0016, 2011_10_03_drive_0016"):
                open_sequence(root, sequence=wanted)

    def test_what_an_interrupted_writer_left_in_hidden_folders_is_not_taken_for_drives(
        self, recordings: Any, drive: Path
    ) -> None:
        recordings.write_raw(drive.parent / ".partial", recordings.ride, name="2011_10_03_drive_0027")
        recordings.write_raw(drive.parents[1] / ".partial", recordings.ride, name="2011_10_03_drive_0042")
        (drive.parents[1] / ".partial/2011_10_03").rename(drive.parents[1] / ".2011_10_03")
        assert list(find(drive.parent)) == list(find(drive.parents[1])) == ["2011_09_30_drive_0016"]

    def test_unsynchronised_recordings_are_not_taken_for_drives(self, drive: Path) -> None:
        (drive.with_name("2011_09_30_drive_0016_extract") / "velodyne_points").mkdir()
        assert list(find(drive.parent)) == ["2011_09_30_drive_0016"]


class TestInertialData:
    def test_without_the_100_hz_recording_the_slow_rows_are_used_with_one_warning(
        self, recordings: Any, tmp_path: Path, caplog: pytest.LogCaptureFixture
    ) -> None:
        path = recordings.write_raw(tmp_path, recordings.ride, extract=False)
        with caplog.at_level(logging.WARNING):
            sequence = open_sequence(path)
        (record,) = caplog.records
        assert "10 Hz" in record.getMessage()
        assert "less accurate" in record.getMessage()
        assert "2011_09_30_drive_0016_extract" in record.getMessage()
        assert sequence.notes == (record.getMessage().removeprefix(f"{sequence.name}: "),)
        np.testing.assert_array_equal(sequence.imu.stamps_ns, recordings.ride.stamps_ns + 4 * MS)

    @pytest.mark.parametrize("lag_ms", [0, 56])
    @pytest.mark.parametrize("fast", [False, True])
    def test_rates_that_are_late_in_the_drives_own_rows_move_to_when_they_were_with_a_note(
        self, recordings: Any, drive: Path, lag_ms: int, fast: bool
    ) -> None:
        extract = drive.with_name("2011_09_30_drive_0016_extract") / "oxts"
        oxts, period_ms = (extract, 10) if fast else (drive / "oxts", 100)
        shutil.rmtree(extract)
        stamps = recordings.ride.start_ns + np.arange(-20, 4000, period_ms) * MS
        rows, seconds = recordings.ride.oxts_rows(stamps), (stamps - recordings.ride.start_ns) / 1e9
        rows[:, 3:6] = np.outer(0.1 * np.sin(3 * seconds), [0, 0, 1])
        rows[:, 17:20] = np.outer(0.3 * np.cos(3 * (seconds - lag_ms / 1e3)), [0, 0, 1])
        recordings.put_rows(oxts, stamps, rows)
        sequence = open_sequence(drive)
        seconds = (sequence.imu.stamps_ns - recordings.ride.start_ns) / 1e9
        known = seconds < 3.8
        np.testing.assert_allclose(sequence.imu.gyro_rad_s[known, 2], 0.3 * np.cos(3 * seconds[known]), atol=0.005)
        assert [note for note in sequence.notes if "late against" in note] == (
            [f"angular rates are {lag_ms} ms late against the attitudes of the same rows; moved back"] if lag_ms else []
        )

    def test_a_simulated_drives_rates_are_found_in_time_without_being_told_that_it_is_simulated(
        self, tmp_path: Path
    ) -> None:
        from hybridlio.simulation import SimulationConfig, simulate

        drive = simulate(tmp_path, SimulationConfig(seconds=3, lidar="16-beam", scene="field", seed=3))
        (drive / "simulation.json").unlink()
        for name in (drive.name, drive.name.replace("sync", "extract")):
            assert read_oxts(drive.with_name(name) / "oxts", Notes("drive")).gyro_lag_ns == 0
        assert not any("late against" in note for note in open_sequence(drive).notes)

    def test_a_frame_before_the_first_sample_carries_none(self, recordings: Any, tmp_path: Path) -> None:
        sequence = open_sequence(recordings.write_raw(tmp_path, recordings.ride, extract=False))
        assert sequence.imu.stamps_ns[0] > sequence.stamps_ns[0]
        assert len(sequence[0].imu) == 0
        assert (sequence[1].imu.stamps_ns <= sequence.stamps_ns[1]).all()

    def test_repeated_and_backward_stamps_are_sorted_out_with_a_count(self, recordings: Any, drive: Path) -> None:
        oxts = drive.with_name("2011_09_30_drive_0016_extract") / "oxts"
        stamps = recordings.ride.imu_stamps_ns(10)
        shuffled = np.concatenate([stamps[:20], [stamps[19]], stamps[[21, 20]], stamps[22:]])
        shutil.rmtree(oxts)
        recordings.put_oxts(oxts, recordings.ride, shuffled)
        sequence = open_sequence(drive)
        np.testing.assert_array_equal(sequence.imu.stamps_ns, stamps)
        assert any("1 of" in note and "go backwards and 1 repeat" in note for note in sequence.notes)

    def test_a_gap_is_noted_with_its_length_and_row(self, drive: Path) -> None:
        oxts = drive.with_name("2011_09_30_drive_0016_extract") / "oxts/data"
        for k in range(41, 60):
            (oxts / f"{k:010d}.txt").unlink()
        sequence = open_sequence(drive)
        assert any("1 gaps, the longest 0.200 s after row 40" in note for note in sequence.notes)

    def test_rows_that_are_not_finite_are_dropped_with_a_count(self, drive: Path) -> None:
        row = drive.with_name("2011_09_30_drive_0016_extract") / "oxts/data/0000000007.txt"
        fields = row.read_text().split()
        row.write_text(" ".join([*fields[:12], "nan", *fields[13:]]))
        sequence = open_sequence(drive)
        assert any("dropped 1 rows" in note and row.name in note for note in sequence.notes)

    @pytest.mark.parametrize("content", ["1 2 3", "a b c", "", " ".join(["0"] * 31)])
    def test_a_row_of_another_shape_is_named(self, drive: Path, content: str) -> None:
        row = drive / "oxts/data/0000000003.txt"
        row.write_text(content)
        with pytest.raises(DataError, match=row.name):
            open_sequence(drive)

    def test_samples_on_another_clock_are_refused(self, recordings: Any, drive: Path) -> None:
        oxts = drive.with_name("2011_09_30_drive_0016_extract") / "oxts"
        late = replace(recordings.ride, start_ns=recordings.ride.start_ns + 3600 * 1000 * MS)
        shutil.rmtree(oxts)
        recordings.put_oxts(oxts, late, late.imu_stamps_ns(10))
        with pytest.raises(DataError, match="shares no time"):
            open_sequence(drive)

    def test_samples_that_start_late_and_end_early_are_noted(self, recordings: Any, drive: Path) -> None:
        oxts = drive.with_name("2011_09_30_drive_0016_extract") / "oxts"
        shutil.rmtree(oxts)
        recordings.put_oxts(oxts, recordings.ride, recordings.ride.imu_stamps_ns(10)[50:90])
        notes = " ".join(open_sequence(drive).notes)
        assert "starts 0.47 s after the first scan" in notes
        assert "ends 0.24 s before the last scan" in notes

    def test_a_drive_without_navigation_rows_still_opens(self, drive: Path) -> None:
        shutil.rmtree(drive / "oxts")
        shutil.rmtree(drive.with_name("2011_09_30_drive_0016_extract"))
        sequence = open_sequence(drive)
        assert len(sequence.imu) == 0
        assert sequence.reference is None
        assert sequence.forward_speed_m_s is None
        assert any("no inertial data" in note for note in sequence.notes)


class TestScans:
    def test_without_stamps_of_their_own_scans_get_those_of_the_navigation_rows(
        self, recordings: Any, tmp_path: Path
    ) -> None:
        sequence = open_sequence(recordings.write_raw(tmp_path, recordings.ride, own_stamps=False))
        np.testing.assert_array_equal(sequence.stamps_ns, recordings.ride.stamps_ns + 4 * MS)
        assert any("stamps of the navigation rows" in note for note in sequence.notes)

    def test_missing_scans_leave_a_gap_and_the_others_keep_their_stamps_and_references(
        self, recordings: Any, drive: Path
    ) -> None:
        for k in (5, 6):
            (drive / f"velodyne_points/data/{k:010d}.bin").unlink()
        sequence, present = open_sequence(drive), [0, 1, 2, 3, 4, 7, 8, 9, 10, 11]
        np.testing.assert_array_equal(sequence.stamps_ns, recordings.ride.stamps_ns[present])
        assert sequence.gaps == ((5, pytest.approx(0.3)),)
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

    def test_scans_with_repeated_or_backward_stamps_are_dropped_and_one_wild_stamp_costs_one_scan(
        self, recordings: Any, drive: Path
    ) -> None:
        lines = scan_stamps(drive)
        lines[4] = lines[3]
        lines[7] = recordings.iso(recordings.ride.start_ns + 10**12)
        put_scan_stamps(drive, lines)
        sequence = open_sequence(drive)
        assert len(sequence) == 10
        assert set(sequence.stamps_ns.tolist()) <= set(recordings.ride.stamps_ns.tolist())
        assert any("dropped 2 scans" in note for note in sequence.notes)

    def test_too_few_stamps_are_refused(self, drive: Path) -> None:
        put_scan_stamps(drive, scan_stamps(drive)[:-1])
        with pytest.raises(DataError, match=r"0000000011\.bin"):
            open_sequence(drive)

    def test_an_unreadable_stamp_is_named_by_file_and_line(self, drive: Path) -> None:
        lines = scan_stamps(drive)
        lines[2] = "2011-09-30 12:00:0"
        put_scan_stamps(drive, lines)
        with pytest.raises(DataError, match=r"timestamps\.txt, line 3"):
            open_sequence(drive)

    @pytest.mark.parametrize("data", [b"", np.full((9, 4), np.nan, "<f4").tobytes()], ids=["empty", "not finite"])
    def test_a_scan_of_no_points_is_refused_with_its_frame(self, drive: Path, data: bytes) -> None:
        (drive / "velodyne_points/data/0000000004.bin").write_bytes(data)
        with pytest.raises(DataError, match=r"frame 4: .*0000000004\.bin"):
            open_sequence(drive)[4]

    def test_points_that_are_not_finite_are_left_out(self, recordings: Any, drive: Path) -> None:
        points = recordings.ride.points(2)
        points[[3, 8], [0, 2]] = np.nan, np.inf
        recordings.put_bin(drive / "velodyne_points/data/0000000002.bin", points)
        assert len(open_sequence(drive)[2].scan) == len(points) - 2


class TestCalibration:
    def test_without_the_imus_place_a_drive_with_inertial_data_does_not_open(self, drive: Path) -> None:
        (drive.parent / "calib_imu_to_velo.txt").unlink()
        with pytest.raises(DataError, match=r"calib_imu_to_velo\.txt"):
            open_sequence(drive)

    @pytest.mark.parametrize("content", ["", "R: 1 0 0 0 1 0 0 0 1\n", "R: 1 2 3\nT: 0 0 0\n", "R: 1\nT: nan 0 0"])
    def test_a_malformed_file_is_named(self, drive: Path, content: str) -> None:
        (drive.parent / "calib_imu_to_velo.txt").write_text(content)
        with pytest.raises(DataError, match=r"calib_imu_to_velo\.txt"):
            open_sequence(drive)

    def test_the_camera_is_the_rectified_one_where_its_rotation_is_known(self, recordings: Any, drive: Path) -> None:
        plain = open_sequence(drive).calibration.T_camera_lidar
        assert plain is not None
        np.testing.assert_allclose(plain, recordings.ride.T_camera_lidar, atol=1e-12)
        quarter = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
        (drive.parent / "calib_cam_to_cam.txt").write_text("R_rect_00: " + " ".join(map(str, quarter.ravel())))
        rectified = open_sequence(drive).calibration.T_camera_lidar
        assert rectified is not None
        np.testing.assert_allclose(rectified[:3], quarter @ plain[:3], atol=1e-12)


class TestReference:
    def test_a_drive_outside_its_navigation_rows_has_no_reference_and_says_so(self, drive: Path) -> None:
        for k in range(5, 12):
            (drive / f"oxts/data/{k:010d}.txt").unlink()
        sequence = open_sequence(drive)
        assert sequence.reference is None
        assert any("no reference poses: scan 11" in note for note in sequence.notes)

    def test_the_forward_speed_is_the_rides(self, drive: Path) -> None:
        np.testing.assert_allclose(open_sequence(drive).forward_speed_m_s, np.full(12, 8.0))

    def test_the_projection_agrees_with_geodesy(self, drive: Path) -> None:
        pymap3d = pytest.importorskip("pymap3d")
        rows = read_oxts(drive / "oxts", Notes("drive"))
        lat, lon, alt = rows.values[:, :3].T
        enu = np.column_stack(pymap3d.geodetic2enu(lat, lon, alt, lat[0], lon[0], alt[0]))
        # KITTI's projection takes the earth as a sphere: up to 0.4 % off at this latitude
        np.testing.assert_allclose(rows.T_enu_imu[:, :3, 3], enu, rtol=0.004, atol=1e-4)


class TestSimulatorsAdditions:
    def test_exact_poses_come_before_those_of_the_navigation_rows(self, recordings: Any, drive: Path) -> None:
        exact = recordings.ride.lidar.poses.copy()
        exact[:, 0, 3] *= 1.01
        write_kitti(drive / "poses.txt", Trajectory(recordings.ride.stamps_ns, exact))
        reference = open_sequence(drive).reference
        assert reference is not None
        np.testing.assert_allclose(reference.poses, exact, atol=1e-11)

    def test_too_few_poses_are_refused(self, recordings: Any, drive: Path) -> None:
        ride = recordings.ride
        write_kitti(drive / "poses.txt", Trajectory(ride.stamps_ns[:-1], ride.lidar.poses[:-1]))
        with pytest.raises(DataError, match=r"poses\.txt"):
            open_sequence(drive)

    def test_the_lidar_and_the_noise_are_what_the_simulation_says(self, drive: Path) -> None:
        noise = ImuNoise(gyro_rad_s_sqrt_hz=3e-4)
        (drive / "simulation.json").write_text(json.dumps({"lidar": "16-beam", "imu_noise": asdict(noise), "seed": 1}))
        sequence = open_sequence(drive)
        assert sequence.lidar is LIDAR_MODELS["16-beam"]
        assert sequence.imu_noise == noise

    @pytest.mark.parametrize("content", ["{", '{"lidar": "hdl-9"}', "[]"])
    def test_a_malformed_description_is_named(self, drive: Path, content: str) -> None:
        (drive / "simulation.json").write_text(content)
        with pytest.raises(DataError, match=r"simulation\.json"):
            open_sequence(drive)

    def test_fixes_come_with_the_frame_they_fall_into(self, recordings: Any, drive: Path) -> None:
        stamps = recordings.ride.stamps_ns[[0, 3, 3, 11]] + np.array([-MS, 0, 1, 5])
        rows = [f"{t},{k},{2 * k},{3 * k},{0.5 * k}" for k, t in enumerate(stamps)]
        (drive / "gps.csv").write_text("\n".join(["stamp_ns,east,north,up,sigma", *rows]))
        sequence = open_sequence(drive)
        assert [[fix.stamp_ns for fix in frame.gps] for frame in sequence][:5] == [
            *[[stamps[0]], [], []],
            *[[stamps[1]], [stamps[2]]],
        ]
        fix = sequence[4].gps[0]
        np.testing.assert_array_equal(fix.position_m, [2, 4, 6])
        np.testing.assert_array_equal(fix.covariance_m2, np.eye(3))
        np.linalg.cholesky(sequence[0].gps[0].covariance_m2)

    @pytest.mark.parametrize(
        ("content", "says"),
        [
            ("stamp_ns,east,north,up\n1,2,3,4\n", "sigma"),
            ("stamp_ns,east,north,up,sigma\n1,2,3,4,5\n1,2,x,4,5\n", "line 3"),
            ("stamp_ns,east,north,up,sigma\n1,2,nan,4,5\n", "line 2"),
            ("stamp_ns,east,north,up,sigma\n1,2\n", "line 2"),
        ],
    )
    def test_malformed_fixes_are_named_by_line(self, drive: Path, content: str, says: str) -> None:
        (drive / "gps.csv").write_text(content)
        with pytest.raises(DataError, match=rf"gps\.csv.*{says}"):
            open_sequence(drive)

    def test_points_carry_their_times_where_the_drive_has_them(self, recordings: Any, drive: Path) -> None:
        folder = drive / "velodyne_points/offsets"
        folder.mkdir()
        offsets = np.arange(len(recordings.ride.points(1)), dtype=np.int64) * 1000 - 20_000
        np.save(folder / "0000000001.npy", offsets)
        sequence = open_sequence(drive)
        np.testing.assert_array_equal(sequence[1].scan.time_offsets_ns, offsets)
        with pytest.raises(DataError, match=r"frame 2: .*0000000002\.npy"):
            sequence[2]
        np.save(folder / "0000000002.npy", offsets[:-5])
        with pytest.raises(DataError, match=r"frame 2: .*time_offsets_ns"):
            sequence[2]

    def test_a_simulated_drive_reads_back_whole(self, tmp_path: Path) -> None:
        pytest.importorskip("open3d")
        from hybridlio.simulation.config import SimulationConfig
        from hybridlio.simulation.simulate import simulate

        config = SimulationConfig(seconds=1.0, lidar="16-beam", motion_distortion=True, gps=True)
        drive = simulate(tmp_path, config)
        sequence = open_sequence(tmp_path)
        assert sequence.notes == ()
        assert sequence.lidar is LIDAR_MODELS["16-beam"]
        assert sequence.imu_noise == config.imu_noise
        assert [len(frame.imu) for frame in sequence][1:] == [11] * (len(sequence) - 1)
        assert all(frame.scan.time_offsets_ns is not None for frame in sequence)
        assert sequence[0].gps
        # the navigation rows say the same as the exact poses, through the projection and the calibration
        exact = sequence.reference
        (drive / "poses.txt").unlink()
        from_rows = open_sequence(tmp_path).reference
        assert exact is not None
        assert from_rows is not None
        np.testing.assert_allclose(from_rows.poses, exact.poses, atol=1e-5)


class TestRealDrives:
    def test_the_city_drive_has_its_length_by_forward_speed(self, kitti_raw_root: Path) -> None:
        sequence = open_sequence(kitti_raw_root, sequence="0005")
        assert len(sequence) == 154
        assert sequence.forward_speed_m_s is not None
        seconds = (sequence.stamps_ns - sequence.stamps_ns[0]) / 1e9
        assert trapezoid(sequence.forward_speed_m_s, seconds) == pytest.approx(71.3, abs=0.1)
        assert sequence.gaps == ()
        assert sequence.reference is not None
        assert sequence.reference.length_m == pytest.approx(69.4, abs=0.2)

    def test_its_gyroscope_and_its_reference_turn_alike(self, kitti_raw_root: Path) -> None:
        sequence = open_sequence(kitti_raw_root, sequence="0005")
        assert sequence.reference is not None
        imu = sequence.imu
        whole: ImuSamples = imu.between(int(sequence.stamps_ns[1]), int(sequence.stamps_ns[-2]))
        turned = trapezoid(whole.gyro_rad_s[:, 2], (whole.stamps_ns - whole.stamps_ns[0]) / 1e9)
        forward = sequence.reference.poses[[1, -2], :3, 0]
        heading = np.arctan2(forward[:, 1], forward[:, 0])
        assert np.degrees(abs(turned)) > 10
        assert turned == pytest.approx(heading[1] - heading[0], abs=np.radians(1.0))

    def test_the_drive_without_scan_stamps_opens_with_those_of_its_rows(self, kitti_raw_root: Path) -> None:
        sequence = open_sequence(kitti_raw_root, sequence="0048")
        assert len(sequence) == 22
        assert set(sequence.stamps_ns) < set(sequence.imu.stamps_ns)
        assert sequence.reference is not None
        assert sequence.reference.length_m == pytest.approx(16.9, abs=0.2)

    def test_the_standing_drive_stands(self, kitti_raw_root: Path) -> None:
        sequence = open_sequence(kitti_raw_root / "2011_09_26/2011_09_26_drive_0060_sync")
        assert sequence.reference is not None
        assert sequence.reference.length_m < 0.05
        np.testing.assert_allclose(sequence.imu.accel_m_s2.mean(axis=0), [0, 0, 9.8], atol=0.4)
        points = sequence[0].scan.points
        assert len(points) > 100_000
        # the sensor is mounted 1.73 m above the road
        near = points[np.linalg.norm(points[:, :2], axis=1) < 15]
        assert np.median(near[near[:, 2] < -1.2, 2]) == pytest.approx(-1.73, abs=0.15)
