"""``hybridlio merge``: of two runs of one place, and what is refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from command_line import ok, refused

from hybridlio.core import se3
from hybridlio.core.trajectory import read_tum, write_tum
from hybridlio.graph import PoseGraph
from hybridlio.localization.open_map import open_prior_map
from hybridlio.runs.folder import read_run

pytestmark = pytest.mark.usefixtures("plain_logging")


@pytest.fixture(scope="module")
def displaced(finished_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same run in another world."""
    folder = tmp_path_factory.mktemp("runs") / "displaced"
    shutil.copytree(finished_run, folder)
    poses = read_tum(folder / "poses_tum.txt")
    world = se3.make(se3.so3_exp([0.0, 0.0, 1.0]), np.array([100.0, -50.0, 0.0]))
    write_tum(folder / "poses_tum.txt", type(poses)(poses.stamps_ns, world @ poses.poses))
    return folder


def test_a_run_in_another_world_joins_itself(finished_run: Path, displaced: Path, tmp_path: Path):
    text = ok("merge", finished_run, displaced, "-o", tmp_path / "map")
    assert "2 runs in the frame of" in text
    merged = json.loads((tmp_path / "map/merge.json").read_text())
    assert merged["unjoined"] == []
    first, second = (read_run(tmp_path / "map" / name).trajectory for name in merged["runs"])
    np.testing.assert_allclose(second.poses[:, :3, 3], first.poses[:, :3, 3], atol=0.05)
    assert len(PoseGraph.load(tmp_path / "map/graph.g2o")) == 2 * merged["first_keys"][1]
    assert open_prior_map(tmp_path / "map" / merged["runs"][1]).places is not None
    ok("merge", finished_run, displaced, "-o", tmp_path / "map")  # again, over its own files


def test_fewer_than_two_runs_are_refused(finished_run: Path, tiny_drive: Path, tmp_path: Path):
    assert "two different run folders" in refused(2, "merge", finished_run, "-o", tmp_path / "map")
    assert "two different run folders" in refused(2, "merge", finished_run, finished_run, "-o", tmp_path / "map")
    assert "not a run folder" in refused(2, "merge", finished_run, tiny_drive, "-o", tmp_path / "map")
