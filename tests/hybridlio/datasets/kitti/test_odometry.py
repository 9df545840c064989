"""KITTI odometry sequences: reference poses, joined inertial data, and bad input."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.errors import DataError
from hybridlio.core.trajectory import read_kitti, write_kitti
from hybridlio.datasets import open_sequence
from hybridlio.datasets.kitti.odometry import RAW_DRIVES

MS = 1_000_000


@pytest.fixture
def folder(recordings: Any, tmp_path: Path) -> Path:
    return recordings.write_odometry(tmp_path / "odometry", recordings.ride)


@pytest.fixture
def raw_root(recordings: Any, tmp_path: Path) -> Path:
    return recordings.write_raw(tmp_path / "raw", recordings.ride).parents[1]


def test_a_sequence_opens_from_its_folder_from_its_root_and_from_inside(folder: Path) -> None:
    for path in (folder, folder.parent, folder.parents[1], folder / "velodyne"):
        assert open_sequence(path).name == "kitti_04"
    shutil.move(folder.parents[1], folder.parents[2] / "dataset")
    assert open_sequence(folder.parents[2]).name == "kitti_04"


def test_a_number_selects_one_of_several_sequences(recordings: Any, folder: Path) -> None:
    root = folder.parents[1]
    recordings.write_odometry(root, recordings.ride, name="07")
    for wanted in ("07", "7"):
        assert open_sequence(root, sequence=wanted).name == "kitti_07"
    with pytest.raises(DataError, match="04, 07"):
        open_sequence(root)


def test_stamps_are_the_same_with_and_without_joined_inertial_data(folder: Path, raw_root: Path) -> None:
    alone, joined = open_sequence(folder), open_sequence(folder, raw_root=raw_root)
    np.testing.assert_array_equal(alone.stamps_ns, joined.stamps_ns)
    assert len(alone.imu) == 0
    assert any("no inertial data" in note for note in alone.notes)
    assert len(joined.imu) > 0


def test_without_camera_stamps_the_navigation_rows_define_the_clock(
    recordings: Any, folder: Path, raw_root: Path
) -> None:
    next(raw_root.rglob("image_00/timestamps.txt")).unlink()
    imu = open_sequence(folder, raw_root=raw_root).imu
    ride = recordings.ride
    np.testing.assert_array_equal(imu.stamps_ns, ride.imu_stamps_ns(10) - ride.start_ns - 4 * MS)


def test_a_sequence_from_the_middle_of_a_drive_starts_at_its_first_frame(
    recordings: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ride, first = recordings.ride, 5
    drive = recordings.write_raw(tmp_path / "raw", replace(ride, start_ns=ride.start_ns - first * 100 * MS))
    monkeypatch.setitem(RAW_DRIVES, "08", replace(RAW_DRIVES["04"], first=first, last=11))
    folder = recordings.write_odometry(tmp_path / "odometry", replace(ride, count=7), name="08")
    imu = open_sequence(folder, raw_root=drive.parents[1]).imu
    assert imu.stamps_ns[0] == -first * 100 * MS - 30 * MS


def test_a_raw_root_without_the_drive_raises_an_error_that_names_the_folder(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"2011_09_30/2011_09_30_drive_0016_sync/oxts"):
        open_sequence(folder, raw_root=tmp_path)


def test_sequence_03_has_no_published_inertial_data(recordings: Any, tmp_path: Path, raw_root: Path) -> None:
    sequence = open_sequence(recordings.write_odometry(tmp_path, recordings.ride, name="03"), raw_root=raw_root)
    assert len(sequence.imu) == 0
    assert any("no published raw drive" in note for note in sequence.notes)


def test_every_training_sequence_except_03_has_a_raw_drive() -> None:
    assert sorted(RAW_DRIVES) == [f"{n:02d}" for n in range(11) if n != 3]
    # the numbers of frames that the benchmark's own ground truth files have
    frames = [4541, 1101, 4661, 271, 2761, 1101, 1101, 4071, 1591, 1201]
    assert [RAW_DRIVES[n].last - RAW_DRIVES[n].first + 1 for n in sorted(RAW_DRIVES)] == frames


def test_with_some_scans_missing_the_reference_starts_at_the_first_present(recordings: Any, folder: Path) -> None:
    present = [2, 3, 6, 11]
    for k in set(range(12)) - set(present):
        (folder / f"velodyne/{k:06d}.bin").unlink()
    sequence = open_sequence(folder)
    np.testing.assert_array_equal(sequence.stamps_ns, np.array(present) * 100 * MS)
    assert sequence.reference is not None
    expected = se3.between(recordings.ride.lidar.poses[2], recordings.ride.lidar.poses[present])
    np.testing.assert_allclose(sequence.reference.poses, expected, atol=1e-9)
    assert any("4 of 12 scans" in note for note in sequence.notes)


def test_writing_the_reference_in_the_camera_frame_reproduces_the_benchmark_file(folder: Path, tmp_path: Path) -> None:
    sequence = open_sequence(folder)
    assert sequence.pose_file_frame == "camera"
    assert sequence.reference is not None
    write_kitti(tmp_path / "again.txt", sequence.reference, sequence.calibration.T_camera_lidar)
    there, again = (read_kitti(p).poses for p in (folder.parents[1] / "poses/04.txt", tmp_path / "again.txt"))
    np.testing.assert_allclose(again, there, atol=1e-11)


def test_a_sequence_without_poses_opens_without_reference(folder: Path) -> None:
    (folder.parents[1] / "poses/04.txt").unlink()
    sequence = open_sequence(folder)
    assert sequence.reference is None
    assert any("no reference poses" in note for note in sequence.notes)


class TestBadInput:
    def test_a_missing_calibration_is_named_in_the_error(self, folder: Path) -> None:
        (folder / "calib.txt").unlink()
        with pytest.raises(DataError, match=r"04/calib\.txt: missing"):
            open_sequence(folder)

    @pytest.mark.parametrize("content", ["P0: 1 2 3\n", "Tr: 1 2 3\n", "Tr: x\n", "Tr: " + "2 " * 12])
    def test_a_calibration_without_a_rigid_transform_is_named_in_the_error(self, folder: Path, content: str) -> None:
        (folder / "calib.txt").write_text(content)
        with pytest.raises(DataError, match=r"calib\.txt"):
            open_sequence(folder)

    def test_a_file_with_too_few_stamps_or_poses_is_named_in_the_error(self, folder: Path) -> None:
        for path in (folder / "times.txt", folder.parents[1] / "poses/04.txt"):
            whole = path.read_text()
            path.write_text("\n".join(whole.splitlines()[:-1]))
            with pytest.raises(DataError, match=path.name):
                open_sequence(folder)
            path.write_text(whole)

    def test_stamps_that_go_backwards_are_rejected(self, folder: Path) -> None:
        lines = (folder / "times.txt").read_text().splitlines()
        lines[3], lines[4] = lines[4], lines[3]
        (folder / "times.txt").write_text("\n".join(lines))
        with pytest.raises(DataError, match=r"times\.txt"):
            open_sequence(folder)

    def test_the_error_names_the_row_of_a_malformed_pose(self, folder: Path) -> None:
        path = folder.parents[1] / "poses/04.txt"
        lines = path.read_text().splitlines()
        lines[6] = lines[6].rsplit(" ", 1)[0]
        path.write_text("\n".join(lines))
        with pytest.raises(DataError, match=r"04\.txt: row 7"):
            open_sequence(folder)


class TestRealSequence:
    def test_scans_on_disk_get_their_stamps_and_reference_poses(self, kitti_odometry_root: Path) -> None:
        sequence = open_sequence(kitti_odometry_root, sequence="00")
        assert len(sequence) == 10
        assert any("scans: 2 gaps" in note for note in sequence.notes)
        times = np.loadtxt(kitti_odometry_root / "sequences/00/times.txt")[[0, 1, 2, 3, 4, 5, 94, 95, 198, 199]]
        np.testing.assert_allclose(sequence.stamps_ns / 1e9, times, atol=1e-9)
        assert sequence.reference is not None
        # the car drives forward: in the lidar's frame along x, where the file's camera has z
        first_steps = sequence.reference.poses[1:6, :3, 3]
        assert (first_steps[:, 0] > 3 * np.abs(first_steps[:, 1])).all()
        assert all(len(frame.scan) > 100_000 for frame in sequence)
