"""``hybridlio map``: from a run folder, from poses in a file, of a part, as tiles, as a mesh, and what is refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from command_line import ok, refused

from hybridlio.core.files import write_atomically
from hybridlio.datasets.points.ply import read_ply

pytestmark = pytest.mark.usefixtures("plain_logging")
COARSE = ("--voxel", 0.5)


def points(path: Path) -> np.ndarray:
    columns = read_ply(path)
    return np.column_stack([columns[axis] for axis in "xyz"])


@pytest.fixture(scope="module")
def whole(finished_run: Path, tmp_path_factory: pytest.TempPathFactory) -> np.ndarray:
    path = tmp_path_factory.mktemp("map") / "map.ply"
    assert "25 scans" in ok("map", finished_run, "-o", path, *COARSE)
    return points(path)


def test_a_run_knows_its_recording_and_a_file_of_its_poses_gives_the_same_map(
    whole: np.ndarray, finished_run: Path, tiny_drive: Path, tmp_path: Path
) -> None:
    assert len(whole) > 1000
    ok("map", tiny_drive, "--poses", finished_run / "poses_tum.txt", "-o", tmp_path / "map.ply", *COARSE)
    np.testing.assert_allclose(len(points(tmp_path / "map.ply")), len(whole), rtol=0.01)


def test_a_part_of_the_scans_gives_a_part_of_the_map(whole: np.ndarray, finished_run: Path, tmp_path: Path) -> None:
    assert "10 scans" in ok("map", finished_run, "-o", tmp_path / "map.ply", "--frames", "5:15", *COARSE)
    assert 100 < len(points(tmp_path / "map.ply")) < len(whole)


def test_tiles_are_listed_with_their_extents(whole: np.ndarray, finished_run: Path, tmp_path: Path) -> None:
    ok("map", finished_run, "-o", tmp_path / "tiles", "--tiles", "ply", *COARSE)
    index = json.loads((tmp_path / "tiles/tiles.json").read_text())
    read = {row["file"]: points(tmp_path / "tiles" / row["file"]) for row in index["tiles"]}
    for row in index["tiles"]:
        assert len(read[row["file"]]) == row["points"]
        np.testing.assert_allclose(read[row["file"]].min(axis=0), row["min"], atol=1e-3)
    assert sum(map(len, read.values())) == len(whole)


def test_a_smaller_map_leaves_no_tiles_of_a_larger_one_and_keeps_what_is_not_its_own(
    finished_run: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "tiles"
    ok("map", finished_run, "-o", folder, "--tiles", "ply", *COARSE)
    (folder / "x+9999_y+9999.ply").write_text("of somebody else")
    larger = {row["file"] for row in json.loads((folder / "tiles.json").read_text())["tiles"]}
    ok("map", finished_run, "-o", folder, "--tiles", "ply", "--max-range", 10, *COARSE)
    smaller = {row["file"] for row in json.loads((folder / "tiles.json").read_text())["tiles"]}
    assert smaller < larger
    assert {path.name for path in folder.glob("*.ply")} == smaller | {"x+9999_y+9999.ply"}
    (folder / "tiles.json").unlink()
    assert "no tile of an earlier map" in refused(2, "map", finished_run, "-o", folder, "--tiles", "ply", *COARSE)
    assert {path.name for path in folder.glob("*.ply")} == smaller | {"x+9999_y+9999.ply"}


def test_the_smoothed_poses_of_a_run_are_used_and_named(finished_run: Path, tmp_path: Path) -> None:
    run = shutil.copytree(finished_run, tmp_path / "run")
    out = ("-o", tmp_path / "map.ply", "--overwrite", *COARSE)
    assert f"by the poses of {run}, " in ok("map", run, *out)
    ok("smooth", run)
    assert f"by the poses of {run / 'smoothed'}, " in ok("map", run, *out)
    online = run / "poses_tum.txt"
    assert f"by the poses of {online}, " in ok("map", run, "--poses", online, *out)


def test_a_mesh_is_written(finished_run: Path, tmp_path: Path) -> None:
    assert "triangles" in ok("map", finished_run, "-o", tmp_path / "mesh.ply", "--mesh", *COARSE)


def test_a_run_whose_recording_moved_takes_its_new_place(finished_run: Path, tiny_drive: Path, tmp_path: Path) -> None:
    run = shutil.copytree(finished_run, tmp_path / "run")
    metrics = json.loads((run / "metrics.json").read_text())
    metrics["recording"]["path"] = str(tmp_path / "gone")
    write_atomically(run / "metrics.json", json.dumps(metrics))
    assert "no such folder" in refused(2, "map", run, "-o", tmp_path / "map.ply")
    ok("map", run, "-o", tmp_path / "map.ply", "--data", tiny_drive, *COARSE)
    del metrics["recording"]
    write_atomically(run / "metrics.json", json.dumps(metrics))
    assert "give it with --data" in refused(2, "map", run, "-o", tmp_path / "map2.ply")


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (("-o", "map.xyz"), "unknown format"),
        (("-o", "map.ply", "--color", "red"), "unknown colour"),
        (("-o", "map.ply", "--voxel", "0"), "voxel_m"),
        (("-o", "map.ply", "--mesh", "--tiles", "ply"), "exclude each other"),
        (("-o", "map.ply", "--georeference"), "GPS"),
        (("-o", "tiles", "--tiles", "doc"), "unknown format"),
    ],
)
def test_what_cannot_work_is_refused(
    finished_run: Path, tmp_path: Path, words: tuple[str, ...], complaint: str
) -> None:
    _, name, *more = words
    assert complaint in refused(1 if "GPS" in complaint else 2, "map", finished_run, "-o", tmp_path / name, *more)


def test_nothing_is_written_into_the_recording(finished_run: Path, tiny_drive: Path) -> None:
    assert "recording" in refused(2, "map", finished_run, "-o", tiny_drive / "map.ply", "--data", tiny_drive)
