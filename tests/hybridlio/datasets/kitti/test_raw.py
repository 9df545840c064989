"""KITTI raw drives: how they are found, and which inertial data are used."""

from __future__ import annotations

import logging
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import trapezoid

from hybridlio.core.errors import DataError
from hybridlio.core.sensors import ImuSamples
from hybridlio.datasets import open_sequence
from hybridlio.datasets.kitti.oxts import read_oxts
from hybridlio.datasets.kitti.raw import find
from hybridlio.datasets.notes import Notes

MS = 1_000_000


class TestFinding:
    def test_a_drive_opens_from_its_folder_its_date_its_root_and_from_inside(self, drive: Path) -> None:
        for path in (drive, drive.parent, drive.parents[1], drive / "velodyne_points", drive / "velodyne_points/data"):
            assert open_sequence(path).name == "2011_09_30_drive_0016"

    def test_a_name_or_number_selects_one_of_several_drives(self, recordings: Any, drive: Path) -> None:
        root = drive.parents[1]
        recordings.write_raw(root, recordings.ride, name="2011_10_03_drive_0027")
        for wanted in ("2011_10_03_drive_0027", "2011_10_03_drive_0027_sync", "0027", "27"):
            assert open_sequence(root, sequence=wanted).name == "2011_10_03_drive_0027"

    def test_an_ambiguous_choice_lists_the_names(self, recordings: Any, drive: Path) -> None:
        root = drive.parents[1]
        recordings.write_raw(root, recordings.ride, name="2011_10_03_drive_0016")
        for wanted in (None, "0016", "0099"):
            with pytest.raises(DataError, match=r"2011_09_30_drive_0016, 2011_10_03_drive_0016"):
                open_sequence(root, sequence=wanted)

    def test_hidden_folders_of_an_interrupted_writer_are_ignored(self, recordings: Any, drive: Path) -> None:
        recordings.write_raw(drive.parent / ".partial", recordings.ride, name="2011_10_03_drive_0027")
        recordings.write_raw(drive.parents[1] / ".partial", recordings.ride, name="2011_10_03_drive_0042")
        (drive.parents[1] / ".partial/2011_10_03").rename(drive.parents[1] / ".2011_10_03")
        assert list(find(drive.parent)) == list(find(drive.parents[1])) == ["2011_09_30_drive_0016"]

    def test_unsynchronised_recordings_are_not_listed_as_drives(self, drive: Path) -> None:
        (drive.with_name("2011_09_30_drive_0016_extract") / "velodyne_points").mkdir()
        assert list(find(drive.parent)) == ["2011_09_30_drive_0016"]


class TestInertialData:
    def test_without_100_hz_data_the_slow_rows_are_used_with_one_warning(
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
    def test_angular_rates_that_lag_are_shifted_back_with_a_note(
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
        assert [note for note in sequence.notes if "lag the attitudes" in note] == (
            [f"angular rates lag the attitudes of the same rows by {lag_ms} ms; shifted back"] if lag_ms else []
        )

    def test_simulated_rates_have_no_lag(self, tmp_path: Path) -> None:
        from hybridlio.simulation import SimulationConfig, simulate

        drive = simulate(tmp_path, SimulationConfig(seconds=3, lidar="16-beam", scene="field", seed=3))
        (drive / "simulation.json").unlink()
        for name in (drive.name, drive.name.replace("sync", "extract")):
            assert read_oxts(drive.with_name(name) / "oxts", Notes("drive")).gyro_lag_ns == 0
        assert not any("lag the attitudes" in note for note in open_sequence(drive).notes)

    def test_a_frame_before_the_first_sample_has_no_samples(self, recordings: Any, tmp_path: Path) -> None:
        sequence = open_sequence(recordings.write_raw(tmp_path, recordings.ride, extract=False))
        assert sequence.imu.stamps_ns[0] > sequence.stamps_ns[0]
        assert len(sequence[0].imu) == 0
        assert (sequence[1].imu.stamps_ns <= sequence.stamps_ns[1]).all()

    def test_repeated_and_backward_stamps_are_sorted_with_a_note(self, recordings: Any, drive: Path) -> None:
        oxts = drive.with_name("2011_09_30_drive_0016_extract") / "oxts"
        stamps = recordings.ride.imu_stamps_ns(10)
        shuffled = np.concatenate([stamps[:20], [stamps[19]], stamps[[21, 20]], stamps[22:]])
        shutil.rmtree(oxts)
        recordings.put_oxts(oxts, recordings.ride, shuffled)
        sequence = open_sequence(drive)
        np.testing.assert_array_equal(sequence.imu.stamps_ns, stamps)
        assert any("1 go backwards and 1 repeat" in note for note in sequence.notes)

    def test_a_gap_is_noted_with_its_length_and_row(self, drive: Path) -> None:
        oxts = drive.with_name("2011_09_30_drive_0016_extract") / "oxts/data"
        for k in range(41, 60):
            (oxts / f"{k:010d}.txt").unlink()
        sequence = open_sequence(drive)
        assert any("1 gap, the longest 0.200 s after row 40" in note for note in sequence.notes)

    def test_rows_that_are_not_finite_are_dropped_with_a_note(self, drive: Path) -> None:
        row = drive.with_name("2011_09_30_drive_0016_extract") / "oxts/data/0000000007.txt"
        fields = row.read_text().split()
        row.write_text(" ".join([*fields[:12], "nan", *fields[13:]]))
        sequence = open_sequence(drive)
        assert any("dropped 1 rows" in note and row.name in note for note in sequence.notes)

    @pytest.mark.parametrize("content", ["1 2 3", "a b c", "", " ".join(["0"] * 31)])
    def test_a_row_with_other_columns_is_named_in_the_error(self, drive: Path, content: str) -> None:
        row = drive / "oxts/data/0000000003.txt"
        row.write_text(content)
        with pytest.raises(DataError, match=row.name):
            open_sequence(drive)

    def test_samples_on_another_clock_are_rejected(self, recordings: Any, drive: Path) -> None:
        oxts = drive.with_name("2011_09_30_drive_0016_extract") / "oxts"
        late = replace(recordings.ride, start_ns=recordings.ride.start_ns + 3600 * 1000 * MS)
        shutil.rmtree(oxts)
        recordings.put_oxts(oxts, late, late.imu_stamps_ns(10))
        with pytest.raises(DataError, match="does not overlap"):
            open_sequence(drive)

    def test_samples_that_start_late_and_end_early_are_noted(self, recordings: Any, drive: Path) -> None:
        oxts = drive.with_name("2011_09_30_drive_0016_extract") / "oxts"
        shutil.rmtree(oxts)
        recordings.put_oxts(oxts, recordings.ride, recordings.ride.imu_stamps_ns(10)[50:90])
        shutil.rmtree(drive / "oxts")
        notes = " ".join(open_sequence(drive).notes)
        assert "starts 0.47 s after the first scan" in notes
        assert "ends 0.24 s before the last scan" in notes

    def test_slow_rows_fill_holes_and_ends_of_the_100_hz_recording(self, recordings: Any, drive: Path) -> None:
        oxts, fast = drive.with_name("2011_09_30_drive_0016_extract") / "oxts", recordings.ride.imu_stamps_ns(10)
        shutil.rmtree(oxts)
        recordings.put_oxts(oxts, recordings.ride, np.concatenate([fast[20:50], fast[80:110]]))
        sequence = open_sequence(drive)
        assert sequence.imu.stamps_ns[0] == recordings.ride.stamps_ns[0] + 4 * MS
        assert sequence.imu.stamps_ns[-1] == recordings.ride.stamps_ns[-1] + 4 * MS
        assert np.diff(sequence.imu.stamps_ns).max() < 170 * MS
        np.testing.assert_allclose(sequence.imu.gyro_rad_s, np.tile([0, 0, 0.2], (len(sequence.imu), 1)), atol=1e-12)
        notes = " ".join(sequence.notes)
        assert "fill holes and ends" in notes
        assert "starts 0.17 s after the first navigation row" in notes

    def test_a_drive_without_navigation_rows_opens(self, drive: Path) -> None:
        shutil.rmtree(drive / "oxts")
        shutil.rmtree(drive.with_name("2011_09_30_drive_0016_extract"))
        sequence = open_sequence(drive)
        assert len(sequence.imu) == 0
        assert sequence.reference is None
        assert sequence.forward_speed_m_s is None
        assert any("no inertial data" in note for note in sequence.notes)


class TestRealDrives:
    def test_the_length_of_the_city_drive_matches_its_forward_speed(self, kitti_raw_root: Path) -> None:
        sequence = open_sequence(kitti_raw_root, sequence="0005")
        assert len(sequence) == 154
        assert sequence.forward_speed_m_s is not None
        seconds = (sequence.stamps_ns - sequence.stamps_ns[0]) / 1e9
        assert trapezoid(sequence.forward_speed_m_s, seconds) == pytest.approx(71.3, abs=0.1)
        assert not any(note.startswith("scans: ") for note in sequence.notes)  # no gaps
        assert sequence.reference is not None
        assert sequence.reference.length_m == pytest.approx(69.4, abs=0.2)

    def test_gyroscope_and_reference_rotate_alike(self, kitti_raw_root: Path) -> None:
        sequence = open_sequence(kitti_raw_root, sequence="0005")
        assert sequence.reference is not None
        imu = sequence.imu
        whole: ImuSamples = imu.between(int(sequence.stamps_ns[1]), int(sequence.stamps_ns[-2]))
        turned = trapezoid(whole.gyro_rad_s[:, 2], (whole.stamps_ns - whole.stamps_ns[0]) / 1e9)
        forward = sequence.reference.poses[[1, -2], :3, 0]
        heading = np.arctan2(forward[:, 1], forward[:, 0])
        assert np.degrees(abs(turned)) > 10
        assert turned == pytest.approx(heading[1] - heading[0], abs=np.radians(1.0))

    def test_a_drive_without_scan_stamps_uses_those_of_its_navigation_rows(self, kitti_raw_root: Path) -> None:
        sequence = open_sequence(kitti_raw_root, sequence="0048")
        assert len(sequence) == 22
        assert set(sequence.stamps_ns) < set(sequence.imu.stamps_ns)
        assert sequence.reference is not None
        assert sequence.reference.length_m == pytest.approx(16.9, abs=0.2)

    def test_the_standing_drive_has_a_constant_reference(self, kitti_raw_root: Path) -> None:
        sequence = open_sequence(kitti_raw_root / "2011_09_26/2011_09_26_drive_0060_sync")
        assert sequence.reference is not None
        assert sequence.reference.length_m < 0.05
        np.testing.assert_allclose(sequence.imu.accel_m_s2.mean(axis=0), [0, 0, 9.8], atol=0.4)
        points = sequence[0].scan.points
        assert len(points) > 100_000
        # the sensor is mounted 1.73 m above the road
        near = points[np.linalg.norm(points[:, :2], axis=1) < 15]
        assert np.median(near[near[:, 2] < -1.2, 2]) == pytest.approx(-1.73, abs=0.15)
