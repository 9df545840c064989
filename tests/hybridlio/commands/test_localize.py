"""``hybridlio localize``: in a run and in a file of points, and what is refused."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from command_line import ok, refused

import hybridlio as hl
from hybridlio.core.errors import ConfigError
from hybridlio.runs.folder import read_run

pytestmark = pytest.mark.usefixtures("plain_logging")


@pytest.fixture(scope="module")
def localized(tiny_drive: Path, finished_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("localized") / "out"
    assert "found in the map" in ok("localize", tiny_drive, "--map", finished_run, "-o", out, "--no-check")
    return out


def test_a_recording_is_found_in_the_map_of_its_own_run(localized: Path, finished_run: Path):
    found, run = read_run(localized), read_run(finished_run)
    np.testing.assert_array_equal(found.trajectory.stamps_ns, run.trajectory.stamps_ns)
    apart = np.linalg.norm(found.trajectory.poses[:, :3, 3] - run.trajectory.poses[:, :3, 3], axis=1)
    assert apart.max() < 0.05


def test_the_table_says_for_each_scan_whether_the_map_held_it(localized: Path):
    with (localized / "localization.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    metrics = json.loads((localized / "metrics.json").read_text())
    assert [int(row["frame"]) for row in rows] == list(range(25))
    held = [int(row["held"]) for row in rows]
    assert held.index(1) == metrics["found"]
    assert np.mean(held) == pytest.approx(metrics["held_share"])
    assert all(0 < float(row["sigma_m"]) < 1 for row in rows)
    assert {row["matched"] == "" for row in rows[: metrics["found"]]} == {True}


def test_a_recording_is_found_in_a_map_file_holds_from_a_start_and_takes_over_the_reference_system(
    tiny_drive: Path, finished_run: Path, tmp_path: Path
):
    laspy, pyproj = pytest.importorskip("laspy"), pytest.importorskip("pyproj")
    coarse = ("--voxel", 0.3, "--no-normals")
    ok("map", finished_run, "-o", tmp_path / "map.laz", *coarse)
    points = laspy.read(tmp_path / "map.laz")
    points.header.add_crs(pyproj.CRS.from_epsg(32632))
    points.write(tmp_path / "map.laz")
    words = ("localize", tiny_drive, "--map", tmp_path / "map.laz", "--no-check", "-o")
    ok(*words, tmp_path / "found")
    found, run = read_run(tmp_path / "found").trajectory, read_run(finished_run).trajectory
    assert np.linalg.norm(found.poses[:, :3, 3] - run.poses[:, :3, 3], axis=1).max() < 0.05
    ok(*words, tmp_path / "out", "--start", "0.5,-0.5,3", "--frames", "0:8")
    metrics = json.loads((tmp_path / "out/metrics.json").read_text())
    assert metrics["found"] == 1
    assert metrics["held_share"] > 0.8
    ok("map", tmp_path / "out", "-o", tmp_path / "own.laz", *coarse)
    assert laspy.read(tmp_path / "own.laz").header.parse_crs().to_epsg() == 32632


def test_a_place_that_is_not_found_is_said_and_nothing_is_written(tiny_drive: Path, finished_run: Path, tmp_path: Path):
    shutil.copytree(finished_run, tmp_path / "map")
    words = ("localize", tiny_drive, "--map", tmp_path / "map", "-o", tmp_path / "out", "--no-check")
    assert "not found in 4 scans" in refused(1, *words, "--frames", "0:4")
    assert not (tmp_path / "out/poses_tum.txt").exists()


def test_a_start_that_the_map_does_not_confirm_is_said(tiny_drive: Path, finished_run: Path, tmp_path: Path):
    words = ("localize", tiny_drive, "--map", finished_run, "-o", tmp_path / "out", "--no-check", "--frames", "0:4")
    assert "not found" in refused(1, *words, "--start", "10,12,90")


def test_wrong_maps_and_starts_are_refused(tiny_drive: Path, tmp_path: Path):
    words = ("localize", tiny_drive, "-o", tmp_path / "out", "--map")
    assert "no such map" in refused(2, *words, tmp_path / "missing.ply")
    assert "not a run folder" in refused(2, *words, tiny_drive)
    assert "X,Y,YAW" in refused(2, *words, tmp_path, "--start", "1,2")


def test_a_path_in_place_of_a_recording_is_refused_with_what_opens_it(tiny_drive: Path, finished_run: Path):
    with pytest.raises(ConfigError, match=r"got str; hl\.open_sequence"):
        hl.localize(str(tiny_drive), finished_run)  # type: ignore[arg-type]
