"""``hybridlio info`` on recordings of every kind."""

from __future__ import annotations

import json
from pathlib import Path

import bags
import numpy as np
import pytest
from typer.testing import CliRunner

from hybridlio.commands.app import app
from hybridlio.datasets import open_sequence
from hybridlio.runs.recording_check import check_recording


@pytest.fixture(scope="module")
def bag(tiny_drive: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    sequence, maker = open_sequence(tiny_drive), bags.Messages(is_ros2=True)
    scans = [sequence.load_scan(k) for k in range(6)]
    content = bags.drive_messages(maker, scans, sequence.imu, sequence.calibration.T_imu_lidar)
    return bags.write(tmp_path_factory.mktemp("bag") / "drive", maker, content, "mcap")


def test_a_bag_is_described_within_80_columns(bag: Path) -> None:
    result = CliRunner().invoke(app, ["info", str(bag)])
    assert result.exit_code == 0, result.output
    assert max(map(len, result.stdout.splitlines())) <= 80
    for text in ("/points     sensor_msgs/PointCloud2", "6 scans in 0.5 s, 10.0 Hz", "x, y, z", "T_imu_lidar"):
        assert text in result.stdout
    assert "point times   none" in result.stdout
    words = " ".join(result.stdout.split())
    (note,) = [note for note in check_recording(open_sequence(bag)).notes if "clock was not found" in note]
    assert f"doubtful: {note}" in words, "info says what a run says"
    assert "clock" not in CliRunner().invoke(app, ["info", str(bag), "--no-check"]).stdout


@pytest.mark.parametrize("kind", ["bag", "drive"])
def test_json_holds_the_same(bag: Path, tiny_drive: Path, kind: str) -> None:
    path = bag if kind == "bag" else tiny_drive
    result = CliRunner().invoke(app, ["info", str(path), "--json"])
    assert result.exit_code == 0, result.output
    values = json.loads(result.stdout)
    assert values["reader"] == ("rosbag" if kind == "bag" else "kitti-raw")
    assert (values["topics"] is None) == (kind == "drive")
    assert values["imu"]["rate_hz"] == pytest.approx(100, rel=0.2)
    assert values["lidar"]["points_per_scan"] > 1000
    np.testing.assert_allclose(values["T_imu_lidar"], open_sequence(path).calibration.T_imu_lidar)


def test_topics_are_listed_also_where_the_choice_is_open(bag: Path) -> None:
    result = CliRunner().invoke(app, ["info", str(bag), "--imu-frame", "mast"])
    assert result.exit_code == 2
    assert "/imu/data" in result.stdout
    assert "no fixed transform between the IMU's frame 'mast'" in result.output


def test_each_note_is_shown_once(tiny_drive: Path, tmp_path: Path) -> None:
    scans = tmp_path / "scans"
    scans.mkdir()
    for k in range(4):
        np.save(scans / f"{k}.npy", open_sequence(tiny_drive)[k].scan.points)
    result = CliRunner().invoke(app, ["info", str(tmp_path), "--rate", "10"])
    assert result.exit_code == 0, result.output
    assert result.output.count("evenly spaced, 10") == 1
    assert result.output.count("no inertial data") == 1


def test_notes_are_shown_also_where_the_recording_cannot_be_opened(tmp_path: Path) -> None:
    (tmp_path / "scans").mkdir()
    for k in range(4):
        np.save(tmp_path / f"scans/{k}.npy", np.full((9, 3), 5e5 + k + 0.3))
    result = CliRunner().invoke(app, ["info", str(tmp_path), "--rate", "10"])
    assert result.exit_code == 2
    assert result.output.count("scans are taken to be evenly spaced") == 1
    assert "in a map's frame" in result.output
