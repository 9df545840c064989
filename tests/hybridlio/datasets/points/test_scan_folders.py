"""Scans in folders of any name, stamps as names of files or beside the scans, and scans of several lidars."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.errors import DataError
from hybridlio.datasets import open_sequence

T_FRONT_REAR = se3.exp([0.02, -0.03, 2.9, -1.5, 0.2, 0.1])


@pytest.fixture
def folder(recordings: Any, tmp_path: Path) -> Path:
    return recordings.write_folder(tmp_path, recordings.ride)


def rename(folder: Path, names: list[str]) -> None:
    (folder / "timestamps.txt").unlink()
    (folder / "imu.csv").unlink()
    for k, name in enumerate(names):
        (folder / f"scans/{k}.npy").rename(folder / f"scans/{name}.npy")


@pytest.mark.parametrize(
    "name",
    {
        "ns": "{ns}",
        "us": "{us}",
        "frame_ns": "frame_{ns}",
        "index_ns": "{k:06}_{ns}",
        "seconds": "{s}.{fraction:09}",
        "short seconds": "{s}.{short}",
        "sec_nsec": "{s}_{fraction}",
        "cloud-sec_nsec": "cloud-{s}_{fraction:09}",
    }.values(),
)
def test_names_of_files_that_are_times_are_stamps(recordings: Any, folder: Path, name: str) -> None:
    stamps = np.asarray(recordings.ride.stamps_ns) // 1000 * 1000
    parts = [(k, int(t), *divmod(int(t), 10**9)) for k, t in enumerate(stamps)]
    names = [
        name.format(k=k, ns=t, us=t // 1000, s=s, fraction=ns, short=f"{ns:09}".rstrip("0") or "0")
        for k, t, s, ns in parts
    ]
    rename(folder, names)
    sequence = open_sequence(folder)
    np.testing.assert_array_equal(sequence.stamps_ns, stamps)
    assert [len(frame.scan) for frame in sequence] == [len(recordings.ride.points(k)) for k in range(12)]
    assert any(note == "stamps are the names of the scans' files" for note in sequence.notes)


@pytest.mark.parametrize("name", ["{k:06}", "scan_{k:010}", "20240131_{k:06}", "{k}"])
def test_numbers_of_scans_are_no_stamps(folder: Path, name: str) -> None:
    rename(folder, [name.format(k=k) for k in range(12)])
    with pytest.raises(DataError, match="write one stamp per line"):
        open_sequence(folder)
    assert np.diff(open_sequence(folder, rate_hz=20).stamps_ns).tolist() == [50_000_000] * 11


def test_a_stated_rate_goes_before_names(recordings: Any, folder: Path) -> None:
    rename(folder, [str(t) for t in recordings.ride.stamps_ns])
    assert open_sequence(folder, rate_hz=20).stamps_ns[1] == 50_000_000


def test_suffixes_may_be_capitals(recordings: Any, folder: Path) -> None:
    for k in range(12):
        (folder / f"scans/{k}.npy").rename(folder / f"scans/{k}.NPY")
    assert [len(frame.scan) for frame in open_sequence(folder)] == [len(recordings.ride.points(k)) for k in range(12)]


def test_stamps_may_stand_beside_the_scans(recordings: Any, folder: Path) -> None:
    (folder / "timestamps.txt").rename(folder / "scans/timestamps.txt")
    np.testing.assert_array_equal(open_sequence(folder).stamps_ns, recordings.ride.stamps_ns)


def test_the_only_folder_of_scans_may_have_any_name(recordings: Any, folder: Path) -> None:
    (folder / "scans").rename(folder / "ouster_points")
    assert len(open_sequence(folder)) == 12


def split(recordings: Any, folder: Path, shift_ns: int | None = 0) -> None:
    """Give the points behind the lidar to another one, whose stamps are ``shift_ns`` later, or not written."""
    (folder / "rear").mkdir()
    for k in range(12):
        points = np.load(folder / f"scans/{k}.npy")
        behind = points[:, 0] < 0
        np.save(folder / f"scans/{k}.npy", points[~behind])
        moved = points[behind].copy()
        moved[:, :3] = se3.transform(se3.inverse(T_FRONT_REAR), moved[:, :3])
        np.save(folder / f"rear/{k}.npy", moved)
    if shift_ns is not None:
        stamps = "".join(f"{t + shift_ns}\n" for t in recordings.ride.stamps_ns)
        (folder / "rear/timestamps.txt").write_text(stamps)


def state(folder: Path, text: str) -> None:
    path = folder / "calibration.yaml"
    path.write_text((path.read_text() if path.is_file() else "") + text)


LIDARS = f"\nlidars: {{rear: {T_FRONT_REAR.tolist()}}}\n"


@pytest.mark.parametrize("shift_ns", [0, 20_000_000, None])
def test_scans_of_a_further_lidar_are_merged(recordings: Any, folder: Path, shift_ns: int | None) -> None:
    split(recordings, folder, shift_ns)
    state(folder, LIDARS)
    sequence = open_sequence(folder)
    assert any("rear has no timestamps.txt" in note for note in sequence.notes) == (shift_ns is None)
    for k in range(12):
        scan, whole = sequence[k].scan, recordings.ride.points(k)[:, :3]
        assert len(scan) == len(whole)
        order, other = np.lexsort(scan.points.T.round(1)), np.lexsort(whole.T.round(1))
        np.testing.assert_allclose(scan.points[order].sum(axis=0), whole[other].sum(axis=0), rtol=1e-3, atol=0.1)
        if shift_ns:
            assert scan.time_offsets_ns is not None
            assert set(scan.time_offsets_ns.tolist()) == {0, shift_ns}


def test_a_further_lidar_without_a_pose_is_said(recordings: Any, folder: Path) -> None:
    split(recordings, folder)
    notes = open_sequence(folder).notes
    assert sum("scans in rear are not used" in note and "'lidars: {rear: …}'" in note for note in notes) == 1


def test_several_folders_of_unusual_names_ask_for_the_first(recordings: Any, folder: Path) -> None:
    split(recordings, folder)
    (folder / "scans").rename(folder / "front")
    with pytest.raises(DataError, match=r"scans in front, rear; name the folder of the first lidar 'scans'"):
        open_sequence(folder)


@pytest.mark.parametrize(("name", "says"), [("left", "no scans in"), ("rear", "no timestamps.txt")])
def test_a_further_lidar_without_scans_or_stamps_is_refused(
    recordings: Any, folder: Path, name: str, says: str
) -> None:
    split(recordings, folder, None)
    (folder / "rear/3.npy").unlink()
    state(folder, LIDARS.replace("rear", name))
    with pytest.raises(DataError, match=says):
        open_sequence(folder)
