"""The table of exit codes in the documentation holds: each code is given by the cases that it names, and no other."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest
from command_line import run

from hybridlio.commands.common import BAD_INPUT, FAILED, INTERRUPTED

pytestmark = pytest.mark.usefixtures("plain_logging", "without_pages")
PAGE = Path(__file__).parents[3] / "docs/how_to/runs.md"


def interrupt(*_: object) -> None:
    raise KeyboardInterrupt


def fill_the_disk(*_: object) -> None:
    raise OSError(28, "No space left on device", "somewhere")


def test_the_table_lists_the_codes_that_the_commands_give() -> None:
    _, _, section = PAGE.read_text().partition("## Exit codes")
    codes = [int(code) for code in re.findall(r"^\| (\d+) \|", section, flags=re.MULTILINE)]
    assert codes == [0, FAILED, BAD_INPUT, INTERRUPTED]


@pytest.mark.parametrize(
    "words", [("config",), ("--version",), ("odometry", "--help"), ("info", "DRIVE"), ("evaluate", "RUN")]
)
def test_success_is_0(words: tuple[str, ...], tiny_drive: Path, finished_run: Path) -> None:
    places = {"DRIVE": tiny_drive, "RUN": finished_run}
    assert run(*(places.get(word, word) for word in words)).exit_code == 0


def test_a_batch_of_which_a_recording_fails_is_1(tiny_drive: Path, tmp_path: Path) -> None:
    bad = shutil.copytree(tiny_drive.parent, tmp_path / "bad" / tiny_drive.parent.name) / tiny_drive.name
    for scan in (bad / "velodyne_points/data").iterdir():
        scan.write_bytes(b"")
    quick = ("--residual", "none", "--engine", "threading")
    assert run("batch", tiny_drive, bad, "-o", tmp_path / "runs", *quick).exit_code == FAILED


def test_an_estimation_that_fails_is_1(finished_run: Path, tmp_path: Path) -> None:
    assert run("smooth", finished_run, "--gps", "-o", tmp_path / "out").exit_code == FAILED  # it has no fixes


def test_a_full_disk_and_a_bug_are_1(finished_run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for failing in (fill_the_disk, lambda *_: 1 / 0):
        monkeypatch.setattr("hybridlio.odometry.config.config_to_yaml", failing)
        assert run("config").exit_code == FAILED


@pytest.mark.parametrize(
    "words",
    [
        ("odometry", "/gone"),
        ("odometry", "/gone", "--no-such-option"),
        ("no-such-command",),
        ("odometry", "DRIVE", "--initial-pose", "magic"),
        ("odometry", "DRIVE", "-o", "DRIVE"),
        ("smooth", "DRIVE"),
        ("evaluate", "RUN", "--reference", "/gone"),
        ("map", "RUN", "-o", "map.doc"),
    ],
)
def test_input_that_cannot_be_used_is_2(words: tuple[str, ...], tiny_drive: Path, finished_run: Path) -> None:
    places = {"DRIVE": tiny_drive, "RUN": finished_run}
    assert run(*(places.get(word, word) for word in words)).exit_code == BAD_INPUT


def test_an_interrupt_is_130(monkeypatch: pytest.MonkeyPatch) -> None:  # test_cli_process sends the signals
    monkeypatch.setattr("hybridlio.odometry.config.config_to_yaml", interrupt)
    assert run("config").exit_code == INTERRUPTED
