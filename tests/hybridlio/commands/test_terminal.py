"""What reaches the terminal: no control characters of names and files, and progress that says what it counts."""

from __future__ import annotations

import contextlib
import re
import sys
from pathlib import Path
from typing import Any

import pytest
from command_line import refused
from rich.console import Console

from hybridlio.commands import terminal
from hybridlio.commands.terminal import print_message, print_result, print_table, progress
from hybridlio.core.errors import strip_control
from hybridlio.core.tables import for_terminal

HOSTILE = "a\x1b[31mred\x1b]0;title\x07\x9b2J\x08\r\x7f\u202eb"


def test_control_characters_are_stripped_and_other_text_is_kept() -> None:
    assert strip_control(HOSTILE) == "ared2Jb"
    assert strip_control("σ m²\tü\n→ 中") == "σ m²\tü\n→ 中"


def test_results_messages_and_tables_have_no_control_characters(capsys: pytest.CaptureFixture[str]) -> None:
    print_result(HOSTILE)
    print_message(HOSTILE)
    print_table(for_terminal([{"recording": HOSTILE}], ("recording",), HOSTILE))
    printed = "".join(capsys.readouterr())
    assert printed.count("ared2Jb") == 4
    assert not set(printed) & set("\x1b\x9b\x08\r\x7f\u202e\x07")


def test_an_error_about_a_path_with_control_characters_is_one_clean_line() -> None:
    line = refused(2, "odometry", "/gone\x1b[31m\x07/data")
    assert "/gone/data" in line
    for path in ("/a\x1b[2J" + "x" * 5000, "~nobody-of-this-name/a"):
        assert "\x1b" not in refused(2, "odometry", path)
        assert "\x1b" not in refused(2, "odometry", "/gone", "-o", path)


TABLE = "choose a topic:\n  /points  100\n  /imu     10"


@pytest.mark.parametrize("width", [40, 80])
@pytest.mark.parametrize("show", [print_message, print_result])
def test_on_a_terminal_nothing_wraps_inside_a_word(
    show: Any, width: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(terminal, "_stderr", lambda: Console(stderr=True))  # the one console reads the colours once
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", str(width))
    text = f"error: {'a-well-known word ' * 30}/{'long-path' * 20}/x: {TABLE}"
    show(text)
    printed = re.sub(r"\x1b\[[\d;]*m", "", "".join(capsys.readouterr()))
    assert printed.split() == text.split()
    assert all(len(line) <= width or " " not in line.strip() for line in printed.splitlines())
    assert printed.rstrip("\n").endswith(TABLE.partition("\n")[2])
    monkeypatch.delenv("FORCE_COLOR")
    show(text)
    assert "".join(capsys.readouterr()) == text + "\n"


def test_progress_says_what_each_stage_counts_and_begins_anew_with_it(capsys: pytest.CaptureFixture[str]) -> None:
    with progress("map", units={"tiles": "tiles"}) as report:
        for stage, total in (("scans added", 30), ("scans compared", 20), ("tiles", 40)):
            for done in range(1, total + 1):
                report(stage, done, total)
    lines = capsys.readouterr().err.splitlines()
    assert [line.partition(" (100 %)")[0] for line in lines] == [
        "map: 30/30 scans",
        "map: 20/20 scans",
        "map: 40/40 tiles",
    ]
    assert "tiles/s" in lines[-1]


def test_progress_that_cannot_be_written_stops_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    with Path("/dev/full").open("w") as full:
        monkeypatch.setattr(sys, "stderr", full)
        for _ in range(2):
            print_message("a line")
        with progress("a run") as report:
            report("", 1, 1)


def test_results_that_cannot_be_written_are_an_error_that_names_stdout(monkeypatch: pytest.MonkeyPatch) -> None:
    full = Path("/dev/full").open("w")  # noqa: SIM115  closing it fails too
    monkeypatch.setattr(sys, "stdout", full)
    with pytest.raises(OSError, match="No space left") as caught:
        print_result("a line")
    assert caught.value.filename == "<stdout>"
    with contextlib.suppress(OSError):
        full.close()
