"""Folders that appear whole: what is left after errors and kills, and two writers of one folder."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path, PurePath

import pytest

from hybridlio.core.errors import ConfigError, DataError
from hybridlio.runs import whole_folder
from hybridlio.runs.whole_folder import held, partial_folder, recover, replaced_folder


def is_own(path: PurePath) -> bool:
    return path.name.startswith("own")


def write(folder: Path, content: str) -> None:
    with replaced_folder(folder, is_own) as part:
        for name in ("own1", "own2"):
            (part / name).write_text(content)


def content_of(folder: Path) -> dict[str, str]:
    return {str(p.relative_to(folder)): p.read_text() for p in folder.rglob("*") if p.is_file()}


@pytest.mark.parametrize("can_exchange", [True, False])
def test_a_folder_is_replaced_as_a_whole_and_keeps_foreign_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, can_exchange: bool
) -> None:
    if not can_exchange:
        monkeypatch.setattr(whole_folder, "_exchange", lambda *_: False)
    folder = tmp_path / "run"
    write(folder, "old")
    (folder / "own3").write_text("old")
    (folder / "mine").write_text("mine")
    write(folder, "new")
    assert content_of(tmp_path) == {"run/own1": "new", "run/own2": "new", "run/mine": "mine"}


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_an_error_or_interrupt_keeps_the_old_folder_and_nothing_else(
    tmp_path: Path, error: type[BaseException]
) -> None:
    write(tmp_path / "run", "old")

    def fail() -> None:
        with replaced_folder(tmp_path / "run", is_own) as part:
            (part / "own1").write_text("half")
            raise error

    with pytest.raises(error):
        fail()
    assert content_of(tmp_path) == {"run/own1": "old", "run/own2": "old"}
    assert [p.name for p in tmp_path.iterdir()] == ["run"]


def test_a_failed_exchange_brings_the_old_folder_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path / "run", "old")
    rename = os.rename

    def fail_to_publish(source: Path, target: Path) -> None:
        if Path(source).name.endswith(".partial"):
            raise OSError(28, "No space left on device", str(source))
        rename(source, target)

    monkeypatch.setattr(whole_folder, "_exchange", lambda *_: False)
    monkeypatch.setattr(os, "rename", fail_to_publish)
    with pytest.raises(DataError, match="No space left"):
        write(tmp_path / "run", "new")
    assert content_of(tmp_path) == {"run/own1": "old", "run/own2": "old"}


KILLED_WRITER = """
import os, signal, sys
from pathlib import Path
from hybridlio.runs import whole_folder
from hybridlio.runs.whole_folder import recover, replaced_folder, held

def is_own(path):
    return path.name.startswith("own")

def write(folder, content):
    with replaced_folder(folder, is_own) as part:
        for name in ("own1", "own2"):
            (part / name).write_text(content)

def killed_at(moment, folder):
    # The child kills itself at its nth system call that concerns a file below the root.
    seen = 0
    def hook(event, args):
        nonlocal seen
        if event in ("open", "os.rename", "os.remove", "os.rmdir", "os.mkdir", "ctypes.dlopen", "os.scandir"):
            seen += 1
            if seen == moment:
                os.kill(os.getpid(), signal.SIGKILL)
    child = os.fork()
    if child == 0:
        sys.addaudithook(hook)
        write(folder, "new")
        os._exit(0)
    return os.waitpid(child, 0)[1] != 0

if sys.argv[2] == "without exchange":
    whole_folder._exchange = lambda a, b: False
root, moment, found = Path(sys.argv[1]), 1, {}
while True:
    folder = root / str(moment) / "run"
    write(folder, "old")
    (folder / "mine").write_text("mine")
    if not killed_at(moment, folder):
        break
    with held(folder):
        recover(folder, is_own)
    found[moment] = {p.name: p.read_text() for p in folder.iterdir()}
    assert found[moment].pop("mine") == "mine", found
    assert found[moment] in ({"own1": "old", "own2": "old"}, {"own1": "new", "own2": "new"}), (moment, found[moment])
    write(folder, "last")
    assert {p.name: p.read_text() for p in root.joinpath(str(moment)).rglob("*") if p.is_file()} == {
        "own1": "last", "own2": "last", "mine": "mine"}, list(root.joinpath(str(moment)).rglob("*"))
    moment += 1
print(moment - 1, sum("old" in content.values() for content in found.values()))
"""


@pytest.mark.parametrize("how", ["with exchange", "without exchange"])
def test_a_writer_killed_at_any_moment_leaves_the_old_or_the_new_folder_whole(tmp_path: Path, how: str) -> None:
    command = [sys.executable, "-c", KILLED_WRITER, str(tmp_path), how]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=Path(__file__).parents[3])
    assert done.returncode == 0, done.stderr
    moments, old = map(int, done.stdout.split())
    assert moments > 20
    assert 5 < old < moments


def test_a_second_writer_is_refused_and_told_which_process_holds_the_folder(tmp_path: Path) -> None:
    def second() -> None:
        with held(tmp_path / "run"):
            pass

    with held(tmp_path / "run"), held(tmp_path / "run"):  # the same thread may hold it twice
        with ThreadPoolExecutor(1) as pool, pytest.raises(ConfigError, match=rf"process {os.getpid()} on "):
            pool.submit(second).result()
        code = "import sys; from pathlib import Path; from hybridlio.runs.whole_folder import held\n"
        code += "with held(Path(sys.argv[1])): pass"
        words = [sys.executable, "-c", code, str(tmp_path / "run")]
        other = subprocess.run(words, capture_output=True, text=True, cwd=Path(__file__).parents[3])
        assert f"run is being written by process {os.getpid()} on" in other.stderr
    second()
    assert list(tmp_path.iterdir()) == []


def test_the_lock_of_a_dead_process_is_taken_over(tmp_path: Path) -> None:
    code = textwrap.dedent("""
        import os, signal, sys
        from pathlib import Path
        from hybridlio.runs.whole_folder import replaced_folder
        with replaced_folder(Path(sys.argv[1]), lambda path: True) as part:
            (part / "own1").write_text("half")
            os.kill(os.getpid(), signal.SIGKILL)
    """)
    words = [sys.executable, "-c", code, str(tmp_path / "run")]
    assert subprocess.run(words, cwd=Path(__file__).parents[3]).returncode == -signal.SIGKILL
    assert sorted(p.name for p in tmp_path.iterdir()) == [".run.lock", ".run.partial"]
    write(tmp_path / "run", "new")
    assert content_of(tmp_path) == {"run/own1": "new", "run/own2": "new"}


def test_foreign_files_are_never_overwritten_by_those_that_come_back(tmp_path: Path) -> None:
    partial = partial_folder(tmp_path / "run")
    partial.mkdir()
    (tmp_path / "run").mkdir()
    for folder in (partial, tmp_path / "run"):
        (folder / "notes").write_text(folder.name)
    with held(tmp_path / "run"):
        recover(tmp_path / "run", is_own)
    assert content_of(tmp_path / "run") == {"notes": "run", "notes.1": ".run.partial"}
