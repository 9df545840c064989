"""Plain folders: kinds of scans and stamps, the IMU CSV, the calibration, and bad input."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.errors import DataError
from hybridlio.core.lidar_models import LIDAR_MODELS
from hybridlio.core.trajectory import Trajectory, write_tum
from hybridlio.datasets import open_sequence


@pytest.fixture
def folder(recordings: Any, tmp_path: Path) -> Path:
    return recordings.write_folder(tmp_path, recordings.ride)


class TestScans:
    def test_scans_are_in_natural_order(self, recordings: Any, folder: Path) -> None:
        # 0.npy 1.npy 10.npy 11.npy 2.npy … as text
        sizes = [len(frame.scan) for frame in open_sequence(folder)]
        assert sizes == [len(recordings.ride.points(k)) for k in range(12)]

    def test_scans_may_be_in_the_folder_itself(self, folder: Path) -> None:
        for path in (folder / "scans").glob("*.npy"):
            path.rename(folder / path.name)
        (folder / "scans").rmdir()
        assert len(open_sequence(folder)) == 12

    def test_a_map_beside_the_scans_folder_is_not_read_as_a_scan(self, recordings: Any, folder: Path) -> None:
        recordings.put_bin(folder / "map.bin", recordings.ride.points(3))
        assert len(open_sequence(folder)) == 12

    @pytest.mark.filterwarnings("error")
    def test_a_scan_without_finite_points_raises_one_line(self, folder: Path) -> None:
        np.save(folder / "scans/0.npy", np.full((10, 4), np.nan))
        with pytest.raises(DataError, match="no finite points"):
            open_sequence(folder)[0]

    def test_scans_of_several_kinds_are_rejected(self, recordings: Any, folder: Path) -> None:
        recordings.put_bin(folder / "scans/3.bin", recordings.ride.points(3))
        with pytest.raises(DataError, match=r"\.bin, \.npy"):
            open_sequence(folder)

    def test_a_folder_of_recordings_opens_by_name(self, recordings: Any, folder: Path) -> None:
        recordings.write_folder(folder.parent / "other", recordings.ride)
        (folder.parent / "other/ride").rename(folder.parent / "second")
        assert open_sequence(folder.parent, sequence="second").name == "second"
        with pytest.raises(DataError, match="ride, second"):
            open_sequence(folder.parent)


class TestStamps:
    @pytest.mark.parametrize("kind", ["seconds", "nanoseconds", "iso"])
    @pytest.mark.parametrize("name", ["timestamps.txt", "times.txt"])
    def test_each_format_is_read_to_the_nanosecond(self, recordings: Any, folder: Path, kind: str, name: str) -> None:
        write = {
            "seconds": lambda t: f"{t // 10**9}.{t % 10**9:09d}",
            "nanoseconds": str,
            "iso": recordings.iso,
        }[kind]
        (folder / "timestamps.txt").unlink()
        (folder / name).write_text("".join(f"{write(int(t))}\n" for t in recordings.ride.stamps_ns))
        np.testing.assert_array_equal(open_sequence(folder).stamps_ns, recordings.ride.stamps_ns)

    def test_missing_stamps_raise_an_error_that_says_what_to_write(self, folder: Path) -> None:
        (folder / "timestamps.txt").unlink()
        with pytest.raises(DataError, match=r"timestamps\.txt or times\.txt; write one stamp per line"):
            open_sequence(folder)

    @pytest.mark.parametrize("lines", [[], ["1.0"], ["1.0"] * 11 + ["now"], [str(k) for k in range(12)]])
    def test_stamps_that_do_not_match_the_scans_are_rejected(self, folder: Path, lines: list[str]) -> None:
        (folder / "timestamps.txt").write_text("\n".join(lines))
        with pytest.raises(DataError, match=r"timestamps\.txt"):
            open_sequence(folder)

    def test_scans_with_repeated_stamps_are_dropped_with_a_note(self, recordings: Any, folder: Path) -> None:
        stamps = recordings.ride.stamps_ns.copy()
        stamps[5] = stamps[4]
        (folder / "timestamps.txt").write_text("\n".join(map(str, stamps)))
        sequence = open_sequence(folder)
        assert len(sequence) == 11
        assert any("dropped 1 scans" in note for note in sequence.notes)


class TestInertialData:
    def test_units_named_in_the_header_are_converted(self, recordings: Any, folder: Path) -> None:
        imu = recordings.ride.imu(recordings.ride.imu_stamps_ns(10))
        rows = ["# t_s, temperature, ax_g, ay_g, az_g, gx_deg_s, gy_deg_s, gz_deg_s"]
        for t, a, g in zip(imu.stamps_ns.tolist(), imu.accel_m_s2 / 9.80665, np.degrees(imu.gyro_rad_s), strict=True):
            rows.append(", ".join([f"{t // 10**9}.{t % 10**9:09d}", "21", *map(str, a), *map(str, g)]))
        (folder / "imu.csv").write_text("\n".join(rows))
        read = open_sequence(folder).imu
        np.testing.assert_array_equal(read.stamps_ns, imu.stamps_ns)
        np.testing.assert_allclose(read.gyro_rad_s, imu.gyro_rad_s, atol=1e-12)
        np.testing.assert_allclose(read.accel_m_s2, imu.accel_m_s2, atol=1e-12)

    def test_a_specific_force_far_from_gravity_is_noted(self, recordings: Any, folder: Path) -> None:
        imu = recordings.ride.imu(recordings.ride.imu_stamps_ns(10))
        csv = recordings.imu_csv(type(imu)(imu.stamps_ns, imu.gyro_rad_s, imu.accel_m_s2 / 100))
        (folder / "imu.csv").write_text(csv)
        assert any("check the unit" in note for note in open_sequence(folder).notes)

    def test_degrees_in_columns_of_radians_are_noted(self, recordings: Any, folder: Path) -> None:
        imu = recordings.ride.imu(recordings.ride.imu_stamps_ns(10))
        (folder / "imu.csv").write_text(
            recordings.imu_csv(type(imu)(imu.stamps_ns, np.degrees(imu.gyro_rad_s), imu.accel_m_s2))
        )
        assert any("rad/s; check the unit" in note for note in open_sequence(folder).notes)

    def test_gravity_of_the_wrong_sign_is_noted(self, recordings: Any, folder: Path) -> None:
        imu = recordings.ride.imu(recordings.ride.imu_stamps_ns(10))
        assert not any("points down" in note for note in open_sequence(folder).notes)
        (folder / "imu.csv").write_text(recordings.imu_csv(type(imu)(imu.stamps_ns, imu.gyro_rad_s, -imu.accel_m_s2)))
        note = next(note for note in open_sequence(folder).notes if "points down in the lidar's frame" in note)
        assert "upside down" in note  # which is no mistake

    @pytest.mark.parametrize(
        "content",
        ["t_s,gx,gy,gz,ax,ay,az\n".encode("utf-16"), b"t_s,temperature \xb0C\n", b't_s\n"' + b"1" * 200_000],
    )
    @pytest.mark.parametrize("name", ["imu.csv", "gps.csv"])
    def test_files_that_are_not_csv_are_named_in_the_error(self, folder: Path, name: str, content: bytes) -> None:
        (folder / name).write_bytes(content)
        with pytest.raises(DataError, match=rf"{name}: "):
            open_sequence(folder)

    def test_rows_out_of_order_are_sorted_and_repeated_or_non_finite_ones_dropped_with_notes(
        self, recordings: Any, folder: Path
    ) -> None:
        header, *rows = (folder / "imu.csv").read_text().splitlines()
        bad = rows[30].split(",")
        bad[3] = "nan"
        rows = [*rows[:10], rows[11], rows[10], rows[12], rows[12], *rows[13:30], ",".join(bad), *rows[31:]]
        (folder / "imu.csv").write_text("\n".join([header, *rows]))
        sequence = open_sequence(folder)
        expected = np.delete(recordings.ride.imu_stamps_ns(10), 30)
        np.testing.assert_array_equal(sequence.imu.stamps_ns, expected)
        assert any("dropped 1 rows that are not finite" in note for note in sequence.notes)
        assert any("1 go backwards and 1 repeat" in note for note in sequence.notes)

    @pytest.mark.parametrize(
        ("content", "says"),
        [
            ("", "header"),
            ("stamp_ns,gx,gy,gz,ax,ay\n", "header must name"),
            ("gx,gy,gz,ax,ay,az\n", "lacks a time such as stamp_ns"),
            ("when,gx,gy,gz,ax,ay,az\n", "lacks a time such as stamp_ns"),
            ("t_s,gx,gy,ax,ay,az\n", "lacks gz"),
            ("t_s,gx (turns),gy,gz,ax,ay,az\n", r"unknown unit 'turns' in 'gx \(turns\)'; known: rad/s"),
            ("t_h,gx,gy,gz,ax,ay,az\n", "lacks a time"),
            ("t (h),gx,gy,gz,ax,ay,az\n", "unknown unit 'h'"),
            ("stamp_ns,gx,gy,gz,ax,ay,az\n", "no row"),
            ("stamp_ns,gx,gy,gz,ax,ay,az\n1,0,0,0,0,0,9\n2,0,0,0,0,9\n", "line 3"),
            ("stamp_ns,gx,gy,gz,ax,ay,az\n1,0,0,0,0,0,up\n", "line 2"),
            ("stamp_ns,gx,gy,gz,ax,ay,az\n1.5,0,0,0,0,0,9\n", "line 2"),
        ],
    )
    def test_the_error_names_the_line_of_a_malformed_file(self, folder: Path, content: str, says: str) -> None:
        (folder / "imu.csv").write_text(content)
        with pytest.raises(DataError, match=rf"imu\.csv.*{says}"):
            open_sequence(folder)

    def test_a_recording_without_imu_opens_with_a_note(self, folder: Path) -> None:
        (folder / "imu.csv").unlink()
        (folder / "calibration.yaml").unlink()
        sequence = open_sequence(folder)
        assert len(sequence.imu) == 0
        assert any("no inertial data" in note for note in sequence.notes)

    def test_the_imu_may_stand_where_euroc_has_it(self, folder: Path) -> None:
        expected = open_sequence(folder).imu
        (folder / "mav0/imu0").mkdir(parents=True)
        (folder / "imu.csv").rename(folder / "mav0/imu0/data.csv")
        np.testing.assert_array_equal(open_sequence(folder).imu.gyro_rad_s, expected.gyro_rad_s)


class TestCalibration:
    def test_imu_data_without_extrinsics_raise_an_error_that_says_what_to_write(self, folder: Path) -> None:
        (folder / "calibration.yaml").unlink()
        with pytest.raises(DataError, match=r"(?s)calibration\.yaml: missing.*T_imu_lidar:\n  - \[1, 0, 0") as caught:
            open_sequence(folder)
        # what the message shows to write is itself accepted
        (folder / "calibration.yaml").write_text("T_imu_lidar:" + str(caught.value).rpartition("T_imu_lidar:")[2])
        np.testing.assert_array_equal(open_sequence(folder).calibration.T_imu_lidar[:3, 3], [0.1, 0.0, 0.3])

    def test_without_imu_the_camera_extrinsics_alone_suffice(self, folder: Path) -> None:
        (folder / "imu.csv").unlink()
        (folder / "calibration.yaml").write_text(f"T_camera_lidar: {se3.exp([0, 0, 0.1, 1, 2, 3]).tolist()}")
        calibration = open_sequence(folder).calibration
        np.testing.assert_array_equal(calibration.T_imu_lidar, np.eye(4))
        np.testing.assert_allclose(calibration.T_camera_lidar, se3.exp([0, 0, 0.1, 1, 2, 3]))

    def test_long_lever_arms_are_noted_and_lengths_in_millimetres_refused(self, folder: Path) -> None:
        for lever_m in ([21, 0, 0], [0, 0, -90]):
            (folder / "calibration.yaml").write_text(f"T_imu_lidar: {se3.make(np.eye(3), lever_m).tolist()}")
            assert any("must be in metres" in note for note in open_sequence(folder).notes)
        (folder / "calibration.yaml").write_text(f"T_imu_lidar: {se3.make(np.eye(3), [110, -320, 80]).tolist()}")
        with pytest.raises(DataError, match=r"is 347.* m from the IMU; the last column must be in metres"):
            open_sequence(folder)

    def test_the_lidar_model_is_read(self, folder: Path) -> None:
        with (folder / "calibration.yaml").open("a") as file:
            file.write("lidar: 32-beam\n")
        assert open_sequence(folder).lidar is LIDAR_MODELS["32-beam"]

    def test_the_gps_antenna_is_read(self, folder: Path) -> None:
        assert open_sequence(folder).calibration.antenna_imu_m is None
        with (folder / "calibration.yaml").open("a") as file:
            file.write("antenna_imu_m: [-0.3, 0.4, 1]\n")
        np.testing.assert_array_equal(open_sequence(folder).calibration.antenna_imu_m, [-0.3, 0.4, 1.0])

    @pytest.mark.parametrize(
        "content",
        [
            "T_imu_lidar: [[1, 0, 0, 0]]",
            "T_imu_lidar: forward",
            "T_imu_lidar: {a: 1}",
            "T_lidar_imu: [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]",
            "T_imu_lidar: [[1,0,0,0],[0,1,0,0],[0,0,-1,0],[0,0,0,1]]",
            "lidar: hdl-9",
            "lidar: 16-beam",
            "lidar: [16-beam]",
            *(
                f"T_imu_lidar: {np.eye(4).tolist()}\nantenna_imu_m: {where}"
                for where in ("[1, 2]", "{x: 1}", "[0, 0, .nan]")
            ),
            "T_imu_lidar: [0.1, 0, 0.2, 0, 0, 0, 1]",
            "[",
            "",
        ],
    )
    def test_a_malformed_file_is_named_in_the_error(self, folder: Path, content: str) -> None:
        (folder / "calibration.yaml").write_text(content)
        with pytest.raises(DataError, match=r"calibration\.yaml"):
            open_sequence(folder)


class TestReference:
    def test_poses_at_other_stamps_are_interpolated(self, recordings: Any, folder: Path) -> None:
        ride = recordings.ride
        stamps = ride.stamps_ns[0] + np.arange(-2, 15) * 77_000_000
        write_tum(folder / "poses_tum.txt", Trajectory(stamps, ride.T_enu_imu(stamps) @ ride.T_imu_lidar))
        reference = open_sequence(folder).reference
        assert reference is not None
        np.testing.assert_allclose(reference.poses, ride.lidar.poses, atol=1e-7)

    def test_poses_that_do_not_cover_all_scans_are_ignored_with_a_note(self, recordings: Any, folder: Path) -> None:
        whole = recordings.ride.lidar
        write_tum(folder / "poses_tum.txt", Trajectory(whole.stamps_ns[:6], whole.poses[:6]))
        sequence = open_sequence(folder)
        assert sequence.reference is None
        assert any("no reference poses" in note for note in sequence.notes)

    def test_a_malformed_file_is_named_in_the_error(self, folder: Path) -> None:
        (folder / "poses_tum.txt").write_text("0 1 2 3\n")
        with pytest.raises(DataError, match=r"poses_tum\.txt"):
            open_sequence(folder)


def test_extrinsics_are_read_as_written(recordings: Any, folder: Path) -> None:
    T = se3.exp([0.1, 0.2, 3.0, 1, 2, 3])
    (folder / "calibration.yaml").write_text(f"T_imu_lidar: {T.tolist()}\nT_camera_lidar: {se3.inverse(T).tolist()}\n")
    calibration = open_sequence(folder).calibration
    np.testing.assert_allclose(calibration.T_imu_lidar, T, atol=1e-14)
    np.testing.assert_allclose(calibration.T_camera_lidar, se3.inverse(T), atol=1e-14)


def test_fixes_on_another_clock_are_noted_and_impossible_latitudes_rejected(folder: Path) -> None:
    (folder / "gps.csv").write_text("stamp_ns,sigma,east,north,up\n1,1,8,49,100\n")
    assert any("no GPS fix is between the first and the last scan" in note for note in open_sequence(folder).notes)
    (folder / "gps.csv").write_text("stamp_ns,sigma,latitude,longitude,height\n1,1,8,49,100\n2,1,115,49,100\n")
    with pytest.raises(DataError, match=r"gps\.csv, line 3: a latitude"):
        open_sequence(folder)
