"""``hybridlio report``: several estimates in one page, files of others, and what is refused."""

from __future__ import annotations

from pathlib import Path

import pytest
from command_line import ok, refused

pytestmark = pytest.mark.usefixtures("plain_logging")


def test_runs_and_files_of_poses_share_a_page(finished_run: Path, tmp_path: Path) -> None:
    poses, truth = finished_run / "poses_tum.txt", finished_run / "reference_tum.txt"
    output = ok("report", finished_run, poses, "--reference", truth, "-o", tmp_path / "r.html")
    assert output.count("poses_tum.txt") == 1
    html = (tmp_path / "r.html").read_text()
    for name in (finished_run.name, "poses_tum.txt", "reference"):
        assert name in html
    assert '"name":"points"' in html.replace(" ", ""), "the points of the first run, below all paths"
    ok("report", poses, finished_run, "--reference", truth, "-o", tmp_path / "files.html")
    assert '"name":"points"' not in (tmp_path / "files.html").read_text().replace(" ", "")


def test_the_reference_of_the_run_is_the_default(finished_run: Path, tmp_path: Path) -> None:
    assert "t_rel" in ok("report", finished_run, "-o", tmp_path / "r.html") or (tmp_path / "r.html").is_file()


def test_equal_names_are_told_apart(finished_run: Path, tmp_path: Path) -> None:
    ok("report", finished_run, finished_run, "-o", tmp_path / "r.html")
    assert f"{finished_run.parent.name}/{finished_run.name} (2)" in (tmp_path / "r.html").read_text()


def test_what_cannot_work_is_refused(finished_run: Path, tiny_drive: Path, tmp_path: Path) -> None:
    (tmp_path / "r.html").write_text("mine")
    assert "exists" in refused(2, "report", finished_run, "-o", tmp_path / "r.html")
    assert (tmp_path / "r.html").read_text() == "mine"
    poses = finished_run / "poses_tum.txt"
    assert "give --reference" in refused(2, "report", poses, "-o", tmp_path / "s.html")
    assert "recording" in refused(2, "report", finished_run, "-o", tiny_drive / "r.html")
