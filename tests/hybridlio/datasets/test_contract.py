"""The contract of every reader, on the same ride written in each reader's layout."""

from __future__ import annotations

import pickle
import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hybridlio.core.errors import ConfigError, DataError
from hybridlio.core.sensors import Scan
from hybridlio.datasets import READERS, Sequence, open_sequence, sequence_names
from hybridlio.datasets.published.table import PUBLISHED

# a new reader is tested by adding how its layout is written: (fixture, folder) -> arguments of open_sequence
WRITERS: dict[str, Callable[[Any, Path], dict[str, Any]]] = {
    "kitti-raw": lambda r, root: {"path": r.write_raw(root, r.ride)},
    "kitti-odometry": lambda r, root: {
        "path": r.write_odometry(root / "odometry", r.ride),
        "raw_root": r.write_raw(root / "raw", r.ride).parents[1],
    },
    "folder": lambda r, root: {"path": r.write_folder(root, r.ride)},
    "rosbag": lambda r, root: {"path": r.write_bag(root, r.ride)},
}


def cut_scan_in_bag(bag: Path, frame: int, size: int) -> None:
    """Shorten a scan's message in an SQLite bag."""
    rows = "SELECT messages.id FROM messages JOIN topics ON topic_id = topics.id WHERE name = '/points'"
    with closing(sqlite3.connect(next(bag.glob("*.db3")))) as connection, connection:
        ((row,),) = connection.execute(f"{rows} ORDER BY timestamp LIMIT 1 OFFSET ?", (frame,))
        connection.execute("UPDATE messages SET data = substr(data, 1, ?) WHERE id = ?", (size, row))


def test_every_reader_is_tested_here_or_beside_its_data_set() -> None:
    assert {*WRITERS, *PUBLISHED, "ouster", "velodyne"} == set(READERS)


@pytest.fixture(scope="module", params=list(WRITERS))
def opened(request: pytest.FixtureRequest, recordings: Any, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The reader's name, the arguments that open the ride, and the sequence."""
    arguments = WRITERS[request.param](recordings, tmp_path_factory.mktemp(request.param))
    return request.param, arguments, open_sequence(**arguments)


@pytest.fixture
def sequence(opened: tuple[str, dict[str, Any], Sequence]) -> Sequence:
    return opened[2]


def test_the_guessed_reader_equals_the_named_one(opened: tuple[str, dict[str, Any], Sequence]) -> None:
    name, arguments, sequence = opened
    named = open_sequence(**arguments, reader=name)
    assert named.name == sequence.name
    np.testing.assert_array_equal(named.stamps_ns, sequence.stamps_ns)


def test_listed_names_can_be_opened(opened: tuple[str, dict[str, Any], Sequence]) -> None:
    _, arguments, sequence = opened
    (name,) = sequence_names(arguments["path"].parent)
    again = open_sequence(arguments["path"].parent, sequence=name, raw_root=arguments.get("raw_root"))
    assert again.name == sequence.name
    assert len(again) == len(sequence)


def test_stamps_increase_and_equal_those_of_the_ride(sequence: Sequence, recordings: Any) -> None:
    stamps = sequence.stamps_ns
    assert stamps.dtype == np.int64
    assert (np.diff(stamps) > 0).all()
    np.testing.assert_array_equal(stamps - stamps[0], recordings.ride.stamps_ns - recordings.ride.start_ns)


def test_frames_hold_the_scans_that_were_written(sequence: Sequence, recordings: Any) -> None:
    for k, frame in enumerate(sequence):
        assert frame.index == k
        assert frame.scan.stamp_ns == sequence.stamps_ns[k]
        written = recordings.ride.points(k).astype(np.float32)
        np.testing.assert_array_equal(frame.scan.points, written[:, :3])
        assert frame.scan.intensity is not None
        np.testing.assert_array_equal(frame.scan.intensity, written[:, 3])


def test_frames_hold_the_imu_samples_since_the_previous_scan(sequence: Sequence) -> None:
    for k in range(1, len(sequence)):
        imu = sequence[k].imu
        assert imu.stamps_ns[0] == sequence.stamps_ns[k - 1]
        assert imu.stamps_ns[-1] == sequence.stamps_ns[k]
        assert 10 <= len(imu) <= 12
    first = sequence[0].imu
    assert first.stamps_ns[-1] == sequence.stamps_ns[0]
    assert first.stamps_ns[0] == sequence.imu.stamps_ns[0]


def test_imu_samples_equal_those_of_the_ride(sequence: Sequence, recordings: Any) -> None:
    ride = recordings.ride
    expected = ride.imu(ride.imu_stamps_ns(10))
    since_start = sequence.imu.stamps_ns - sequence.stamps_ns[0]
    np.testing.assert_array_equal(since_start, expected.stamps_ns - ride.start_ns)
    np.testing.assert_allclose(sequence.imu.gyro_rad_s, expected.gyro_rad_s, atol=1e-12)
    np.testing.assert_allclose(sequence.imu.accel_m_s2, expected.accel_m_s2, atol=1e-12)


def test_the_extrinsics_equal_those_of_the_ride(sequence: Sequence, recordings: Any) -> None:
    np.testing.assert_allclose(sequence.calibration.T_imu_lidar, recordings.ride.T_imu_lidar, atol=1e-12)


def test_the_reference_is_the_lidar_path_of_the_ride_from_the_identity(sequence: Sequence, recordings: Any) -> None:
    reference = sequence.reference
    assert reference is not None
    np.testing.assert_array_equal(reference.stamps_ns, sequence.stamps_ns)
    np.testing.assert_allclose(reference.poses[0], np.eye(4), atol=1e-12)
    # KITTI's degrees and quaternions have about this many digits
    np.testing.assert_allclose(reference.poses, recordings.ride.lidar.poses, atol=1e-5)


def test_negative_indices_count_from_the_end_and_indices_out_of_range_raise(sequence: Sequence) -> None:
    last = len(sequence) - 1
    assert sequence[-1].index == last
    np.testing.assert_array_equal(sequence[-1].scan.points, sequence[last].scan.points)
    for outside in (len(sequence), -len(sequence) - 1):
        with pytest.raises(IndexError):
            sequence[outside]


def test_iterating_twice_gives_the_same_frames(sequence: Sequence) -> None:
    for a, b in zip(sequence, sequence, strict=True):
        assert (a.index, a.scan.stamp_ns) == (b.index, b.scan.stamp_ns)
        np.testing.assert_array_equal(a.scan.points, b.scan.points)
        np.testing.assert_array_equal(a.imu.stamps_ns, b.imu.stamps_ns)


def test_a_scan_is_loaded_once_per_requested_frame(sequence: Sequence) -> None:
    asked = []

    def load(k: int) -> Scan:
        asked.append(k)
        return sequence.load_scan(k)

    counted = replace(sequence, load_scan=load)
    assert counted[4].scan.stamp_ns == sequence.stamps_ns[4]
    assert asked == [4]


def test_a_sequence_can_be_pickled(sequence: Sequence) -> None:
    copy = pickle.loads(pickle.dumps(sequence))
    np.testing.assert_array_equal(copy[3].scan.points, sequence[3].scan.points)


def test_a_truncated_scan_raises_on_access_and_the_others_still_load(
    opened: tuple[str, dict[str, Any], Sequence], recordings: Any, tmp_path: Path
) -> None:
    if opened[0] == "rosbag":
        pytest.skip("scans of a bag are no files; see the next test")
    arguments = WRITERS[opened[0]](recordings, tmp_path)
    sequence = open_sequence(**arguments)
    scan = sorted(p for p in arguments["path"].rglob("*") if p.suffix in (".bin", ".npy"))[3]
    frame = next(k for k in range(len(sequence)) if sequence.load_scan.paths[k] == scan)  # type: ignore[attr-defined]
    for data in (scan.read_bytes()[:-7], b""):
        scan.write_bytes(data)
        with pytest.raises(DataError, match=rf"frame {frame}: .*{scan.name}"):
            sequence[frame]
    check_bridged(sequence, frame)
    scan.unlink()
    with pytest.raises(DataError, match=rf"frame {frame}: .*{scan.name}"):
        sequence[frame]
    assert len(sequence[0].scan) > 0


@pytest.mark.parametrize("size", [40, 500])
def test_a_truncated_scan_in_a_bag_raises_on_access_and_the_others_still_load(
    recordings: Any, tmp_path: Path, size: int
) -> None:
    bag = WRITERS["rosbag"](recordings, tmp_path)["path"]
    cut_scan_in_bag(bag, 3, size)
    sequence = open_sequence(bag)
    with pytest.raises(DataError, match=r"frame 3: .*ride, /points"):
        sequence[3]
    check_bridged(sequence, 3)
    assert [len(sequence[k].scan) for k in (2, 4)] == [52, 54]


def check_bridged(sequence: Sequence, frame: int) -> None:
    bridged = sequence.without_scan(frame)
    assert (bridged.index, bridged.scan.stamp_ns, len(bridged.scan)) == (frame, sequence.stamps_ns[frame], 0)
    assert len(bridged.imu) >= 10


def test_a_slice_of_a_sequence_is_refused_with_what_to_use(tiny_drive: Path):
    with pytest.raises(ConfigError, match=r"part\(start, stop\) and every\(step\)"):
        open_sequence(tiny_drive)[1:3]  # type: ignore[index]


def test_a_sequences_repr_is_one_line(tiny_drive: Path):
    assert repr(open_sequence(tiny_drive)).endswith(
        ", 25 scans in 2.4 s, 281 IMU samples, 0 GPS fixes, with reference)"
    )
