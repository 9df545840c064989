"""Several lidars of one body are merged: as if one lidar had measured all points, each at its time."""

from __future__ import annotations

import logging
import pickle
from pathlib import Path
from typing import Any

import bags
import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import ConfigError, DataError
from hybridlio.core.sensors import Scan
from hybridlio.datasets import Sequence, open_sequence
from hybridlio.datasets.rosbag.choices import BagTopics

T_LEFT_RIGHT = se3.exp([0.1, -0.2, 2.5, 0.3, -1.2, 0.4])
BOTH = BagTopics(lidar="/left,/right")
CLOUD = "sensor_msgs/msg/PointCloud2"


def part(scan: Scan, rows: Any, T_part: Array, shift_ns: int = 0) -> Scan:
    """Some points of a scan as another lidar measures them, whose stamp is ``shift_ns`` later."""
    points = se3.transform(se3.inverse(T_part), scan.points[rows]).astype(np.float32)
    assert scan.time_offsets_ns is not None
    assert scan.intensity is not None
    offsets = scan.time_offsets_ns[rows] - shift_ns
    return Scan(scan.stamp_ns + shift_ns, points, scan.intensity[rows], offsets)


def write(path: Path, drive: Any, halves: Any, has_frames: bool = True) -> Path:
    """Write a drive whose scans ``halves`` divides among lidars: topic -> (frame, scans)."""
    maker = bags.Messages(is_ros2=True)
    content = [row for row in drive.messages(maker) if row[1] != "/points"]
    for topic, (frame, scans) in halves.items():
        for scan in scans:
            cloud = maker.cloud(scan.stamp_ns, bags.structured(scan), frame)
            content.append((scan.stamp_ns + 2_000_000, topic, CLOUD, cloud))
    if has_frames:
        transform = maker.transform(0, "lidar", "right", T_LEFT_RIGHT)
        content.append((content[0][0], "/tf_static", "tf2_msgs/msg/TFMessage", maker.tf(transform)))
    return bags.write(path, maker, content, "mcap")


def divided(drive: Any, shift_ns: int = 0) -> dict[str, tuple[str, list[Scan]]]:
    """The left half of every scan by one lidar, the other by one whose stamps are ``shift_ns`` later."""
    left = [part(s, s.points[:, 1] > 0, np.eye(4)) for s in drive.scans]
    right = [part(s, s.points[:, 1] <= 0, T_LEFT_RIGHT, shift_ns) for s in drive.scans]
    return {"/left": ("lidar", left), "/right": ("right", right)}


def check_whole(sequence: Sequence, drive: Any) -> None:
    assert len(sequence) == len(drive.scans)
    for k, scan in enumerate(drive.scans):
        merged = sequence[k].scan
        assert len(merged) == len(scan)
        assert merged.time_offsets_ns is not None
        order, other = (np.lexsort((s.points[:, 0].round(2), s.time_offsets_ns)) for s in (merged, scan))
        np.testing.assert_array_equal(merged.time_offsets_ns[order], scan.time_offsets_ns[other])
        by_time, expected = (
            [s.points[rows][s.time_offsets_ns[rows] == t].sum(axis=0) for t in np.unique(scan.time_offsets_ns)[::50]]
            for s, rows in ((merged, order), (scan, other))
        )
        np.testing.assert_allclose(by_time, expected, atol=2e-3)


@pytest.mark.parametrize("shift_ms", [0, 30, -30])
def test_two_lidars_give_the_scans_that_were_divided_among_them(
    shift_ms: int, drive_with_times: Any, tmp_path: Path
) -> None:
    path = write(tmp_path / "two", drive_with_times, divided(drive_with_times, shift_ms * 1_000_000))
    sequence = open_sequence(path, topics=BOTH)
    check_whole(sequence, drive_with_times)
    assert any("/right: 12 scans merged" in note for note in sequence.notes)
    copy = pickle.loads(pickle.dumps(sequence.load_scan))
    np.testing.assert_array_equal(copy(3).points, sequence[3].scan.points)


def test_all_scans_of_a_faster_lidar_are_merged(drive_with_times: Any, tmp_path: Path) -> None:
    halves = divided(drive_with_times)
    fast = []
    for scan in halves["/right"][1]:
        assert scan.time_offsets_ns is not None
        middle = int(np.median(scan.time_offsets_ns))
        for rows, shift_ns in ((scan.time_offsets_ns < middle, 0), (scan.time_offsets_ns >= middle, middle)):
            fast.append(part(scan, rows, np.eye(4), shift_ns))
    halves["/right"] = ("right", sorted(fast, key=lambda scan: scan.stamp_ns))
    check_whole(open_sequence(write(tmp_path / "fast", drive_with_times, halves), topics=BOTH), drive_with_times)


def test_without_a_choice_the_error_says_that_several_can_be_merged(drive_with_times: Any, tmp_path: Path) -> None:
    path = write(tmp_path / "two", drive_with_times, divided(drive_with_times))
    with pytest.raises(DataError, match="2 lidar topics; choose one, for example --lidar-topic /left, or several"):
        open_sequence(path)


def test_the_pose_of_a_further_lidar_may_be_written(drive_with_times: Any, tmp_path: Path) -> None:
    path = write(tmp_path / "two", drive_with_times, divided(drive_with_times), has_frames=False)
    with pytest.raises(DataError, match=r"between the lidars' frames 'lidar' and 'right'.*(?s:.)*lidars:\n  /right"):
        open_sequence(path, topics=BOTH)
    (path / "calibration.yaml").write_text(f"lidars: {{/right: {T_LEFT_RIGHT.tolist()}}}\n")
    check_whole(open_sequence(path, topics=BOTH), drive_with_times)


def test_points_of_the_vehicle_are_left_out_of_all_lidars(drive_with_times: Any, tmp_path: Path) -> None:
    path = write(tmp_path / "two", drive_with_times, divided(drive_with_times))
    (path / "calibration.yaml").write_text("vehicle: {min: [-9, -9, -9], max: [9, 9, 9]}\n")
    points = open_sequence(path, topics=BOTH)[2].scan.points
    assert (points[:, 1] <= 0).any()
    assert (np.abs(points) > 9).any(axis=1).all()


def test_a_further_lidar_on_another_clock_is_refused(drive_with_times: Any, tmp_path: Path) -> None:
    halves = divided(drive_with_times)
    halves["/right"] = ("right", [part(s, slice(None), np.eye(4), 10**11) for s in halves["/right"][1]])
    with pytest.raises(DataError, match=r"/right: no scan is within 75 ms.*clocks of the lidars must be one"):
        open_sequence(write(tmp_path / "late", drive_with_times, halves), topics=BOTH)


def test_a_scan_of_a_further_lidar_that_cannot_be_read_is_left_out_with_a_warning(
    drive_with_times: Any, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    halves = divided(drive_with_times)
    broken = halves["/right"][1][5]
    halves["/right"][1][5] = Scan(broken.stamp_ns, np.zeros((3, 3), np.float32), np.zeros(3), np.zeros(3, np.int64))
    sequence = open_sequence(write(tmp_path / "two", drive_with_times, halves), topics=BOTH)
    with caplog.at_level(logging.WARNING):
        assert (sequence[5].scan.points[:, 1] > 0).all()
    assert "/right is left out of scan 5" in caplog.text


@pytest.mark.parametrize("names", ["/left,/left", "/left,"])
def test_lidars_need_different_names(names: str) -> None:
    with pytest.raises(ConfigError, match="give different names"):
        BagTopics(lidar=names)
