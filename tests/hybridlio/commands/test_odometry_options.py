"""Which scans `hybridlio odometry` uses, and names that are not UTF-8."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import ok, refused

from hybridlio.core.errors import ConfigError
from hybridlio.core.trajectory import read_tum
from hybridlio.datasets.sequence import Sequence
from hybridlio.runs.results.map_source import open_map_source

pytestmark = pytest.mark.usefixtures("plain_logging", "without_pages")
QUICK = ("--residual", "none")


@pytest.mark.parametrize(
    ("words", "rows"),
    [
        (("--start", 3, "--n-scans", 6), slice(3, 9)),
        (("-n", 4), slice(0, 4)),
        (("--start", 20), slice(20, None)),
        (("--every", 4), slice(None, None, 4)),
        (("--every", 2, "--frames", "1:9"), slice(1, 9, 2)),
        (("--every", 3, "-n", 5, "--start", 2), slice(2, 17, 3)),  # N scans are used, as with KISS-ICP
        (("--jump", 20), slice(20, None)),  # as in KISS-ICP
    ],
)
def test_the_scans_to_use_can_be_chosen(
    words: tuple[object, ...], rows: slice, tiny_drive: Path, sequence: Sequence, tmp_path: Path
) -> None:
    ok("odometry", tiny_drive, *QUICK, *words, "-o", tmp_path / "run")
    assert read_tum(tmp_path / "run/poses_tum.txt").stamps_ns.tolist() == sequence.stamps_ns[rows].tolist()


def test_a_run_of_every_third_scan_opens_its_recording_again(
    tiny_drive: Path, sequence: Sequence, tmp_path: Path
) -> None:
    ok("odometry", tiny_drive, *QUICK, "--start", 2, "--every", 3, "-o", tmp_path / "run")
    source = open_map_source(tmp_path / "run")
    assert source.sequence.stamps_ns.tolist() == sequence.stamps_ns[2::3].tolist()
    assert source.sequence.part(1, 3).every(2).source == replace(source.sequence.source, start=5, stop=11, step=6)
    assert "8 scans" in ok("map", tmp_path / "run", "-o", tmp_path / "map.ply", "--voxel", 0.5)


def test_two_ways_to_choose_them_are_one_too_many(tiny_drive: Path) -> None:
    assert "give one of them" in refused(2, "odometry", tiny_drive, "--frames", "0:5", "--start", 2)


def test_every_second_frame_has_the_samples_since_the_one_before(sequence: Sequence) -> None:
    part = sequence.every(2)
    assert len(part) == 13
    assert sequence.reference is not None
    assert part.reference is not None
    assert np.allclose(part.reference.poses[3], sequence.reference.poses[6], atol=1e-12)
    assert part[3].imu.stamps_ns[[0, -1]].tolist() == sequence.stamps_ns[[4, 6]].tolist()
    assert np.array_equal(part[3].scan.points, sequence[6].scan.points)
    assert sequence.every(1) is sequence
    with pytest.raises(ConfigError, match="one scan in 0 is none"):
        sequence.every(0)


@pytest.mark.parametrize("utf8", ["0", "1"])
def test_names_that_are_not_utf_8_work(utf8: str, sequence: Sequence, tmp_path: Path, project_root: Path) -> None:
    folder = os.fsencode(tmp_path) + b"/bad\xffname"
    os.makedirs(folder + b"/scans")
    for k in range(3):
        with open(folder + b"/scans/%d.npy" % k, "wb") as file:
            np.save(file, sequence[k].scan.points)
    with open(folder + b"/timestamps.txt", "w", encoding="ascii") as file:
        file.write("".join(f"{stamp / 1e9:.9f}\n" for stamp in sequence.stamps_ns[:3]))
    command = [sys.executable, "-m", "hybridlio", "odometry", folder, *QUICK, "-o", folder + b"-run"]
    env = {**os.environ, "PYTHONUTF8": utf8, "LC_ALL": "C", "PYTHONPATH": str(project_root), "MPLBACKEND": "Agg"}
    done = subprocess.run(command, env=env, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr
    assert b"poses   " in done.stdout
    with open(folder + b"-run/metrics.json", "rb") as file:
        assert json.load(file)["sequence"] == "bad\udcffname"
