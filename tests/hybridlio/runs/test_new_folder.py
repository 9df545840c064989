"""Which folders may take a new run, and what is kept when one is replaced."""

import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from threading import Barrier

import pytest

from hybridlio.core.errors import ConfigError, DataError
from hybridlio.datasets.registry import open_sequence
from hybridlio.odometry.config import Config
from hybridlio.odometry.odometry import Odometry
from hybridlio.runs.folder import is_own_file, is_run_folder
from hybridlio.runs.new_folder import link_latest, new_run_folder
from hybridlio.runs.own_files import check_free
from hybridlio.runs.run import Run, run_odometry
from hybridlio.runs.write import write_run

CONFIG = Config(residual="none")


@pytest.fixture(autouse=True)
def quick(without_pages) -> None:
    """Skip the reports."""


@pytest.fixture(scope="module")
def run(tiny_drive) -> Run:
    return run_odometry(open_sequence(tiny_drive).part(0, 3), Odometry(config=CONFIG))


def test_a_run_is_replaced_only_with_overwrite(run, tmp_path):
    write_run(tmp_path / "run", run, CONFIG)
    with pytest.raises(ConfigError, match="--overwrite"):
        check_free(tmp_path / "run", overwrite=False)
    check_free(tmp_path / "run", overwrite=True)


def test_a_new_run_removes_the_files_of_an_old_one_and_keeps_other_files(run, tmp_path):
    folder = tmp_path / "run"
    write_run(folder, run, CONFIG)
    (folder / "smoothed").mkdir()
    (folder / "my figures/deep").mkdir(parents=True)
    (folder / ".smoothed.partial").mkdir()
    for own in ("smoothed/poses_tum.txt", "run.log", ".smoothed.partial/odometry.npz", ".report.0123456789ab.html"):
        (folder / own).write_text("old")
    others = ("my notes.txt", "smoothed/thesis.txt", "my figures/deep/a.png", ".hidden")
    for other in others:
        (folder / other).write_text("mine")
    write_run(folder, replace(run, sequence=replace(run.sequence, reference=None)), CONFIG)
    assert not (folder / "reference_tum.txt").exists()
    assert {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()} == {
        *others, *(p.name for p in folder.iterdir() if is_own_file(p.relative_to(folder)))
    }  # fmt: skip
    assert all((folder / other).read_text() == "mine" for other in others)
    assert not (folder / "run.log").exists()
    assert [p.name for p in tmp_path.iterdir()] == ["run"]


@pytest.mark.parametrize("name", ["config.yaml", "metrics.json", "poses_tum.txt", "smoothed/thesis.txt", "notes.txt"])
def test_a_folder_with_files_of_somebody_else_is_left_alone_whatever_the_options(run, tmp_path, name):
    mine = tmp_path / "mine" / name
    mine.parent.mkdir(parents=True)
    mine.write_text("{}")
    for overwrite in (False, True):
        with pytest.raises(ConfigError, match="holds files but no run of hybridlio"):
            check_free(tmp_path / "mine", overwrite)
    with pytest.raises(ConfigError, match="left alone"):
        write_run(tmp_path / "mine", run, CONFIG)
    assert mine.read_text() == "{}"


def test_a_half_run_that_an_older_version_left_is_replaced_with_overwrite(run, tmp_path):
    (tmp_path / "odometry.npz").write_text("half")
    (tmp_path / ".poses_tum.0123456789ab.txt").write_text("half")
    with pytest.raises(ConfigError):
        check_free(tmp_path, overwrite=False)
    check_free(tmp_path, overwrite=True)
    write_run(tmp_path, run, CONFIG)
    assert is_run_folder(tmp_path)


def test_default_folders_are_named_after_the_sequence_and_unique_within_a_second(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with (
        new_run_folder("town", None, overwrite=False) as first,
        new_run_folder("town", None, overwrite=False) as second,
    ):
        assert first != second
        assert all(re.fullmatch(r"runs/town-\d{8}-\d{6}(-\d)?", str(path)) for path in (first, second))
    assert list((tmp_path / "runs").iterdir()) == []  # nothing was written


def test_runs_that_begin_at_once_get_different_folders(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ready, begun = Barrier(8), Barrier(8)

    def begin(_: int) -> Path:
        ready.wait()
        with new_run_folder("town", None, overwrite=False) as folder:
            begun.wait()
            return folder

    with ThreadPoolExecutor(8) as runs:
        assert len(set(runs.map(begin, range(8)))) == 8


def test_the_error_for_a_run_folder_that_cannot_be_created_names_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("runs").write_text("a file")
    for out in (None, Path("runs/mine")):
        with pytest.raises(DataError, match="runs"), new_run_folder("town", out, overwrite=False):
            pass
    with pytest.raises(ConfigError, match="runs is not a folder"):
        check_free(Path("runs"), overwrite=True)


def test_a_relative_folder_and_the_current_one_can_be_written(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        with new_run_folder("town", Path("."), overwrite=True) as folder:
            write_run(folder, run, CONFIG)
        assert is_run_folder(tmp_path)
        (tmp_path / "notes.txt").write_text("mine")
    assert all(is_own_file(p.relative_to(tmp_path)) for p in tmp_path.iterdir() if p.name != "notes.txt")
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]


def test_latest_links_to_the_newest_run_by_a_relative_path(tmp_path):
    for name in ("a", "b"):
        (tmp_path / "runs" / name).mkdir(parents=True)
        link_latest(tmp_path / "runs" / name)
    (tmp_path / "runs").rename(tmp_path / "moved")
    assert (tmp_path / "moved/latest").resolve() == tmp_path / "moved/b"
    assert sorted(path.name for path in (tmp_path / "moved").iterdir()) == ["a", "b", "latest"]


def test_an_existing_folder_or_foreign_link_named_latest_is_kept(tmp_path):
    (tmp_path / "latest").mkdir()
    (tmp_path / "a").mkdir()
    link_latest(tmp_path / "a")
    assert not (tmp_path / "latest").is_symlink()
    (tmp_path / "latest").rmdir()
    (tmp_path / "latest").symlink_to("/somewhere/else")
    link_latest(tmp_path / "a")
    assert (tmp_path / "latest").readlink() == Path("/somewhere/else")
