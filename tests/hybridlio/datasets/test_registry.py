"""Choosing the reader that fits a path, and the errors if none does."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from hybridlio.core.errors import ConfigError, DataError
from hybridlio.datasets import READERS, open_sequence, sequence_names


def test_if_no_reader_fits_the_error_lists_all_layouts(tmp_path: Path) -> None:
    with pytest.raises(DataError) as caught:
        open_sequence(tmp_path)
    for name, reader in READERS.items():
        assert f"{name}: {reader.layout}" in str(caught.value)


def test_only_the_named_reader_is_tried(recordings: Any, tmp_path: Path) -> None:
    folder = recordings.write_folder(tmp_path, recordings.ride)
    with pytest.raises(DataError, match="kitti-raw") as caught:
        open_sequence(folder, reader="kitti-raw")
    assert "kitti-odometry" not in str(caught.value)


def test_an_unknown_reader_lists_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="kitti-raw, kitti-odometry, folder"):
        open_sequence(tmp_path, reader="rosbag2")


def test_a_path_that_is_not_a_folder_is_named_in_the_error(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"nowhere: no such folder"):
        open_sequence(tmp_path / "nowhere")
    file = tmp_path / "scan.bin"
    file.write_bytes(b"")
    with pytest.raises(DataError, match=r"scan\.bin: not a folder"):
        open_sequence(str(file))


def test_sequence_names_lists_all_recordings_at_a_path(recordings: Any, tmp_path: Path) -> None:
    for name in ("00", "04", "11"):
        recordings.write_odometry(tmp_path, recordings.ride, name=name)
    assert sequence_names(tmp_path) == ("00", "04", "11")


def test_listing_readers_loads_no_heavy_library() -> None:
    code = "import sys, hybridlio.datasets as d; d.READERS; print(*{'open3d', 'torch', 'gtsam'} & sys.modules.keys())"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == ""
