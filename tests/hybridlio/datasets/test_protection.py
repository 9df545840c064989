"""Recordings are never written to: which folders are refused."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from hybridlio.core.errors import ConfigError
from hybridlio.datasets.protection import check_new_file, check_output, is_recording


def touch(root: Path, *names: str) -> None:
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()


LAYOUTS = {
    "KITTI raw": ("velodyne_points/data/0000000000.bin",),
    "KITTI odometry": ("velodyne/000000.bin", "times.txt"),
    "plain folder": ("scans/0.ply", "timestamps.txt"),
    "flat folder": ("0.npy", "times.txt"),
    "split bag": ("metadata.yaml", "a_0.db3"),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_folder_that_is_holds_or_lies_inside_a_recording_is_refused(tmp_path: Path, layout: str) -> None:
    recording = tmp_path / "data/date/drive"
    touch(recording, *LAYOUTS[layout])
    assert is_recording(recording)
    with pytest.raises(ConfigError, match="is a recording"):
        check_output(recording)
    for inside in ("run", "a/b/c"):
        with pytest.raises(ConfigError, match=rf"lies inside the recording {recording}"):
            check_output(recording / inside)
    for above in (recording.parent, tmp_path / "data", tmp_path):
        with pytest.raises(ConfigError, match=rf"holds the recording {recording}"):
            check_output(above)
        check_output(above, may_hold=True)
    with pytest.raises(ConfigError, match="is a recording"):
        check_output(recording, may_hold=True)
    check_output(recording.parent / "runs")
    check_output(tmp_path / "runs/new")


def test_a_link_into_a_recording_or_a_path_with_dots_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    touch(tmp_path / "drive", *LAYOUTS["plain folder"])
    (tmp_path / "link").symlink_to(tmp_path / "drive")
    monkeypatch.chdir(tmp_path)
    for path in ("link", "link/run", "x/../drive", "./drive/scans"):
        with pytest.raises(ConfigError, match="recordings are never written to"):
            check_output(path)


def test_a_bag_and_a_recording_of_any_layout_that_is_named_are_protected(tmp_path: Path) -> None:
    touch(tmp_path, "bags/ride.bag", "odd/layout.pcap")
    with pytest.raises(ConfigError, match=r"holds the recording .*ride\.bag"):
        check_output(tmp_path / "bags")
    for folder in (tmp_path / "odd", tmp_path / "odd/layout.pcap"):
        with pytest.raises(ConfigError, match="recording"):
            check_output(folder, tmp_path / "odd/layout.pcap")
    check_output(tmp_path / "odd")


def test_shards_and_clouds_without_stamps_are_no_recordings(tmp_path: Path) -> None:
    touch(tmp_path, "shards/a/shard.json", "shards/a/points.npy", "maps/town.ply")
    check_output(tmp_path / "shards")
    check_output(tmp_path / "maps/run")


def test_a_folder_that_cannot_be_listed_does_not_stop_the_check(tmp_path: Path) -> None:
    touch(tmp_path, "private/a/x")
    os.chmod(tmp_path / "private", 0)
    try:
        check_output(tmp_path)
    finally:
        os.chmod(tmp_path / "private", 0o700)


def test_scans_without_stamps_are_protected_where_they_are_the_input(tmp_path: Path) -> None:
    touch(tmp_path, "drive/scans/0.bin")
    for out in ("drive", "drive/run", "."):
        with pytest.raises(ConfigError, match="recordings are never written to"):
            check_output(tmp_path / out, tmp_path / "drive")


def test_a_file_is_replaced_only_if_it_is_said_and_a_bag_never(tmp_path: Path) -> None:
    touch(tmp_path, "map.ply", "ride.bag", "drive/velodyne_points/data/0000000000.bin")
    header = b"\x89MCAP0\r\n\x01" + (40).to_bytes(8, "little")  # of the first record
    (tmp_path / "ride.mcap").write_bytes(header + (4).to_bytes(4, "little") + b"ros2")
    (tmp_path / "export.mcap").write_bytes(header + (0).to_bytes(4, "little") + b"\x06\0\0\0")
    check_new_file(tmp_path / "new.ply", False)
    for name in ("map.ply", "export.mcap"):
        with pytest.raises(ConfigError, match="exists; choose another file, or give --overwrite"):
            check_new_file(tmp_path / name, False)
        check_new_file(tmp_path / name, True)
    for name in ("ride.bag", "ride.mcap", "drive/map.ply"):
        with pytest.raises(ConfigError, match="recordings are never written to"):
            check_new_file(tmp_path / name, True)
    with pytest.raises(ConfigError, match="is a folder"):
        check_new_file(tmp_path / "drive", True)
