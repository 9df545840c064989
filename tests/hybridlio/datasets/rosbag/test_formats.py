"""The same drive in every format of bags, whole, compressed, split and damaged."""

from __future__ import annotations

import functools
import pickle
import re
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bags
import lz4.frame
import numpy as np
import pytest
import yaml

from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.datasets import Sequence, open_sequence, sequence_names

# name of the bag -> (ROS 2, storage, compression, Livox driver)
FORMATS: dict[str, tuple[bool, str, str, str]] = {
    "ros1.bag": (False, "", "", ""),
    "ros1-lz4.bag": (False, "", "lz4", ""),
    "ros1-bz2.bag": (False, "", "bz2", ""),
    "ros1-livox.bag": (False, "", "", "livox_ros_driver"),
    "ros2-sqlite3": (True, "sqlite3", "", ""),
    "ros2-sqlite3-file": (True, "sqlite3", "file", ""),
    "ros2-sqlite3-message": (True, "sqlite3", "message", ""),
    "ros2-mcap": (True, "mcap", "", ""),
    "ros2-mcap-storage": (True, "mcap", "storage", ""),
    "ros2-livox": (True, "mcap", "", "livox_ros_driver2"),
}


def write(folder: Path, name: str, drive: Any, keep: Callable[[int], bool] = lambda _: True) -> Path:
    is_ros2, storage, compress, livox = FORMATS[name]
    maker = bags.Messages(is_ros2)
    content = [row for row in drive.messages(maker, livox=livox) if keep(row[0])]
    return bags.write(folder / name, maker, content, storage, compress)


def check_equal(sequence: Sequence, plain: Sequence, has_livox: bool = False) -> None:
    np.testing.assert_array_equal(sequence.stamps_ns, plain.stamps_ns)
    np.testing.assert_array_equal(sequence.imu.stamps_ns, plain.imu.stamps_ns)
    np.testing.assert_array_equal(sequence.imu.gyro_rad_s, plain.imu.gyro_rad_s)
    np.testing.assert_array_equal(sequence.imu.accel_m_s2, plain.imu.accel_m_s2)
    np.testing.assert_allclose(sequence.calibration.T_imu_lidar, plain.calibration.T_imu_lidar, atol=1e-12)
    assert sequence.reference is not None
    assert plain.reference is not None
    np.testing.assert_allclose(sequence.reference.poses, plain.reference.poses, atol=1e-6)
    for k in range(len(plain)):
        ours, theirs = sequence[k].scan, plain[k].scan
        np.testing.assert_array_equal(ours.points, theirs.points)
        assert ours.time_offsets_ns is not None
        assert ours.intensity is not None
        assert theirs.time_offsets_ns is not None
        np.testing.assert_array_equal(ours.time_offsets_ns, theirs.time_offsets_ns)
        np.testing.assert_allclose(ours.intensity, theirs.intensity, atol=0.5 / 255 if has_livox else 0)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_gives_the_frames_of_the_plain_folder(
    name: str, drive_with_times: Any, plain: Sequence, tmp_path: Path
) -> None:
    sequence = open_sequence(write(tmp_path, name, drive_with_times))
    assert sequence.name == Path(name).stem
    check_equal(sequence, plain, has_livox="livox" in name)


@pytest.mark.parametrize("name", ["ros1.bag", "ros2-sqlite3", "ros2-mcap", "ros1-livox.bag", "ros2-livox"])
def test_estimates_equal_those_from_the_plain_folder(
    name: str, drive_with_times: Any, plain_poses: Array, tmp_path: Path
) -> None:
    sequence = open_sequence(write(tmp_path, name, drive_with_times))
    np.testing.assert_allclose(drive_with_times.estimates(sequence), plain_poses, atol=1e-6)


@pytest.mark.parametrize("name", ["ros2-mcap", "ros2-sqlite3"])
def test_files_of_ros_2_are_read_without_their_metadata(
    name: str, drive_with_times: Any, plain: Sequence, tmp_path: Path
) -> None:
    (file,) = (p for p in write(tmp_path, name, drive_with_times).iterdir() if p.suffix != ".yaml")
    alone = shutil.copy(file, tmp_path / f"alone{file.suffix}")
    check_equal(open_sequence(alone), plain)


def test_words_in_the_place_of_counts_are_one_clear_error(drive_with_times: Any, tmp_path: Path) -> None:
    bag = write(tmp_path, "ros2-mcap", drive_with_times)
    metadata = bag / "metadata.yaml"
    metadata.write_text(re.sub(r"message_count: \d+", "message_count: abc", metadata.read_text()))
    with pytest.raises(DataError, match="truncated or damaged"):
        open_sequence(bag)


def halves(folder: Path, name: str, drive: Any) -> list[Path]:
    """Write the drive as two bags in folders ``0`` and ``1``."""
    middle = int(drive.sequence.stamps_ns[6])
    keeps: list[Callable[[int], bool]] = [lambda t: t < middle, lambda t: t >= middle]
    made = []
    for number, keep in enumerate(keeps):
        (folder / str(number)).mkdir(parents=True)
        made.append(write(folder / str(number), name, drive, keep))
    return made


@pytest.mark.parametrize("name", ["ros1.bag", "ros2-mcap", "ros2-sqlite3"])
def test_numbered_parts_alone_in_a_folder_are_one_bag(
    name: str, drive_with_times: Any, plain: Sequence, tmp_path: Path
) -> None:
    (tmp_path / "split").mkdir()
    for number, made in enumerate(halves(tmp_path / "parts", name, drive_with_times)):
        (file,) = (p for p in ([made] if made.is_file() else made.iterdir()) if p.suffix != ".yaml")
        shutil.move(file, tmp_path / f"split/drive_2024-01-01-10-0{number}-00_{number}{file.suffix}")
    sequence = open_sequence(tmp_path / "split")
    assert sequence.name == "split"
    check_equal(sequence, plain)
    first = next((tmp_path / "split").glob("*_0.*"))
    alone = open_sequence(first)
    assert len(alone) < len(plain)
    assert any("part 0 of a split bag; give the folder" in note for note in alone.notes)


def test_a_split_folder_of_ros_2_is_one_bag(drive_with_times: Any, plain: Sequence, tmp_path: Path) -> None:
    first, second = halves(tmp_path / "parts", "ros2-mcap", drive_with_times)
    folder, key = tmp_path / "whole", "rosbag2_bagfile_information"
    folder.mkdir()
    about, other = (yaml.safe_load((half / "metadata.yaml").read_text())[key] for half in (first, second))
    for number, half in enumerate((first, second)):
        shutil.copy(next(half.glob("*.mcap")), folder / f"whole_{number}.mcap")
    about["relative_file_paths"] = ["whole_0.mcap", "whole_1.mcap"]
    about["message_count"] += other["message_count"]
    about["duration"]["nanoseconds"] += other["duration"]["nanoseconds"]
    for topic in about["topics_with_message_count"]:
        name = topic["topic_metadata"]["name"]
        counts = {t["topic_metadata"]["name"]: t["message_count"] for t in other["topics_with_message_count"]}
        topic["message_count"] += counts.get(name, 0)
    (folder / "metadata.yaml").write_text(yaml.safe_dump({key: about}))
    check_equal(open_sequence(folder), plain)


def test_scans_are_found_in_any_order_and_in_copies_of_the_sequence(
    drive_with_times: Any, plain: Sequence, tmp_path: Path
) -> None:
    import pickle

    for name in ("ros1-lz4.bag", "ros2-mcap", "ros2-sqlite3"):
        sequence = open_sequence(write(tmp_path, name, drive_with_times))
        for opened in (sequence, pickle.loads(pickle.dumps(sequence))):
            for k in (7, 8, 3, 11, 0, 1, 5, 4):
                np.testing.assert_array_equal(opened[k].scan.points, plain[k].scan.points)


def test_several_bags_in_a_folder_are_recordings_by_name(small: Any) -> None:
    for name in ("north.bag", "south.bag"):
        small.write(small.standard(), name=name)
    assert sequence_names(small.folder) == ("north", "south")
    assert open_sequence(small.folder, sequence="south").name == "south"
    with pytest.raises(DataError, match="several recordings; choose a sequence: north, south"):
        open_sequence(small.folder)


@pytest.mark.parametrize("name", ["ros1.bag", "ros1-lz4.bag", "ros2-mcap", "ros2-mcap-storage", "ros2-sqlite3"])
@pytest.mark.parametrize("share", [0.0, 0.01, 0.4, 0.9, 0.9999])
def test_a_truncated_bag_gives_its_first_scans_with_a_note_or_one_line_that_names_it(
    name: str, share: float, drive_with_times: Any, plain: Sequence, tmp_path: Path
) -> None:
    path = write(tmp_path, name, drive_with_times)
    file = path if path.is_file() else next(p for p in path.iterdir() if p.suffix in (".db3", ".mcap"))
    file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    try:
        sequence = open_sequence(path)
    except DataError as error:
        text = str(error)
        assert name in text
        assert share < 0.4 or name == "ros2-sqlite3"
    else:
        lost = "scans before the damage are used" if name == "ros2-sqlite3" else "it was made again from"
        (text,) = (note for note in sequence.notes if lost in note)
        assert len(sequence) >= 2
        for k in range(len(sequence)):
            np.testing.assert_array_equal(sequence[k].scan.points, plain[k].scan.points)
    assert len(text.splitlines()) == 1


@pytest.mark.parametrize("name", ["ros1.bag", "ros1-bz2.bag", "ros2-mcap", "ros2-mcap-storage"])
def test_a_bag_whose_index_alone_is_lost_is_whole(
    name: str, drive_with_times: Any, plain: Sequence, tmp_path: Path
) -> None:
    path = write(tmp_path, name, drive_with_times)
    file = path if path.is_file() else next(path.glob("*.mcap"))
    data = bytearray(file.read_bytes())
    if name.startswith("ros1"):  # as rosbag record leaves it: index_pos=0, and no index
        at = data.index(b"index_pos=") + 10
        (end,) = struct.unpack_from("<Q", data, at)
        data[at : at + 8] = bytes(8)
        file.write_bytes(data[:end])
    else:
        file.write_bytes(data[: struct.unpack_from("<Q", data, len(data) - 28)[0]])
    sequence = open_sequence(path)
    check_equal(sequence, plain)
    check_equal(pickle.loads(pickle.dumps(sequence)), plain)
    assert any("the index is missing or damaged" in note for note in sequence.notes)


def damaged(path: Path, at: int) -> None:
    data = bytearray(path.read_bytes())
    data[at : at + 4000] = b"\xa5" * 4000
    path.write_bytes(data)


def test_chunks_before_a_damaged_one_are_read(drive_with_times: Any, tmp_path: Path) -> None:
    path = write(tmp_path, "ros1-lz4.bag", drive_with_times)
    whole, data = open_sequence(path), path.read_bytes()
    damaged(path, data.index(lz4.frame.compress(b"")[:4], len(data) // 2))  # where a chunk starts
    sequence = open_sequence(path)
    assert 2 <= len(sequence) < len(whole)
    np.testing.assert_array_equal(sequence[1].scan.points, whole[1].scan.points)
    assert any("truncated or damaged" in note and "before the damage are used" in note for note in sequence.notes)


def test_of_a_chunk_damaged_behind_its_start_only_its_clouds_are_lost(drive_with_times: Any, tmp_path: Path) -> None:
    path = write(tmp_path, "ros1-lz4.bag", drive_with_times)
    whole = [frame.scan.points for frame in open_sequence(path)]
    damaged(path, path.stat().st_size * 7 // 10)
    sequence = open_sequence(path)
    scans = [opened_or_error(functools.partial(sequence.load_scan, k), "ros1-lz4") for k in range(len(sequence))]
    lost = [k for k, scan in enumerate(scans) if scan is None]
    assert len(scans) == len(whole)
    assert lost == [*range(lost[0], lost[-1] + 1)]
    assert len(lost) <= 3
    for scan, points in zip(scans, whole, strict=True):
        if scan is not None:
            np.testing.assert_array_equal(scan.points, points)


def opened_or_error(opener: Callable[[], Any], place: str) -> Any:
    """Return what ``opener`` returns, or None where it raises an error that names the place."""
    error = ""
    try:
        return opener()
    except DataError as raised:
        error = str(raised)
    assert place in error
    return None


@pytest.mark.parametrize("name", ["ros1.bag", "ros2-mcap", "ros2-sqlite3"])
def test_damaged_bytes_give_a_result_or_one_clear_error(
    name: str, drive_with_times: Any, tmp_path: Path, rng: np.random.Generator
) -> None:
    path = write(tmp_path, name, drive_with_times)
    file = path if path.is_file() else next(p for p in path.iterdir() if p.suffix in (".db3", ".mcap"))
    whole = file.read_bytes()
    for _ in range(12):
        data = bytearray(whole)
        for at in rng.integers(0, len(data), size=20):
            data[at] = rng.integers(256)
        data[: len(data) // 50] = whole[: len(data) // 50]  # else all end at the first bytes
        file.write_bytes(data)
        sequence = opened_or_error(lambda: open_sequence(path), name)
        for k in range(len(sequence or ())):
            opened_or_error(functools.partial(sequence.__getitem__, k), f"frame {k}")


def test_a_file_that_is_no_bag_is_refused(tmp_path: Path) -> None:
    for name, text in (("a.bag", b"hello"), ("a.mcap", b"hello"), ("a.db3", b"hello" * 1000)):
        (tmp_path / name).write_bytes(text)
        with pytest.raises(DataError, match=rf"{name}: cannot be read, the bag is truncated or damaged"):
            open_sequence(tmp_path / name)
    (tmp_path / "a.txt").write_text("hello")
    with pytest.raises(DataError, match=r"a.txt: not a folder; give .*, or a bag or capture \(.*\.bag, \.mcap"):
        open_sequence(tmp_path / "a.txt")
