"""A run is on the disk as it goes, and goes on from there after a kill or a full disk to the same result."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import ok, refused, run

from hybridlio.core.errors import ConfigError
from hybridlio.core.sensors import Frame
from hybridlio.core.trajectory import read_tum
from hybridlio.datasets.registry import open_sequence
from hybridlio.datasets.sequence import Sequence
from hybridlio.odometry.config import Config
from hybridlio.odometry.estimate import Estimate
from hybridlio.odometry.odometry import Odometry
from hybridlio.record import journal
from hybridlio.runs.folder import COVARIANCES, KITTI, POSES, RECORD
from hybridlio.runs.run import Run, finish_run
from hybridlio.runs.unfinished import keeper as keeper_module
from hybridlio.runs.unfinished.keeper import Keeper
from hybridlio.runs.unfinished.kept import read_kept, resume_run
from hybridlio.runs.whole_folder import JOURNAL, STATE, partial_folder

pytestmark = pytest.mark.usefixtures("without_pages", "plain_logging")
KILLED = """
import os, signal, sys
from hybridlio.odometry.odometry import Odometry
from hybridlio.runs.unfinished import keeper
keeper._BLOCK_SCANS, keeper._BLOCK_S, keeper._STATE_SHARE = 5, 1e9, 1e9  # often enough for a drive of two seconds
step = Odometry.step
def killed(self, frame):
    if frame.index == 18:
        os.kill(os.getpid(), signal.SIGKILL)
    return step(self, frame)
Odometry.step = killed
from hybridlio.commands.app import app
app()
"""


def killed_odometry(root: Path, *words: object) -> None:
    """Run ``hybridlio odometry`` in a process that is killed when it begins with scan 18."""
    command = [sys.executable, "-c", KILLED, "odometry", *map(str, words)]
    done = subprocess.run(command, env={**os.environ, "PYTHONPATH": str(root)}, capture_output=True, check=False)
    assert done.returncode == -signal.SIGKILL, done.stderr


@pytest.fixture(scope="module")
def killed_run(tiny_drive: Path, project_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run that was killed; tests copy the hidden folder that holds its journal."""
    out = tmp_path_factory.mktemp("killed") / "run"
    killed_odometry(project_root, tiny_drive, "-o", out)
    return out


@pytest.fixture
def killed(killed_run: Path, tmp_path: Path) -> Path:
    out, part = tmp_path / "run", partial_folder(tmp_path / "run")
    part.mkdir()
    for name in (JOURNAL, STATE):
        (part / name).write_bytes((partial_folder(killed_run) / name).read_bytes())
    return out


def contents(folder: Path) -> dict[str, Any]:
    """Return the results of a run that do not depend on the time that it took."""
    found: dict[str, Any] = {name: (folder / name).read_text() for name in (POSES, KITTI)}
    for name in (RECORD, COVARIANCES):
        with np.load(folder / name) as arrays:
            found |= {f"{name}/{key}": arrays[key].tobytes() for key in arrays.files}
    metrics = json.loads((folder / "metrics.json").read_text())
    return found | {key: value for key, value in metrics.items() if key not in ("seconds", "ms_per_scan")}


def test_a_killed_run_goes_on_to_the_same_result(killed: Path, finished_run: Path, tiny_drive: Path) -> None:
    kept = read_kept(partial_folder(killed))
    assert kept is not None
    assert len(kept.estimates) == 15  # 18 were estimated; a block has 5 here
    ok("odometry", tiny_drive, "-o", killed, "--resume")
    assert contents(killed) == contents(finished_run)
    assert [path.name for path in killed.parent.iterdir()] == ["run"]
    assert not (killed / JOURNAL).exists()


def test_the_scans_before_the_kill_can_be_smoothed(killed: Path) -> None:
    out = ok("smooth", killed, "--loops")
    assert "15 poses" in out
    smoothed = killed.parent / "run-smoothed"
    assert len(read_tum(smoothed / POSES)) == 15
    notes = json.loads((smoothed / "metrics.json").read_text())["notes"]
    assert "killed after 15 of 25 scans" in notes
    assert (partial_folder(killed) / JOURNAL).exists()


def test_an_unfinished_run_is_not_overwritten_unless_that_is_wanted(killed: Path, tiny_drive: Path) -> None:
    error = refused(2, "odometry", tiny_drive, "-o", killed, "--residual", "none")
    assert "was killed; give --resume to go on from its estimates, or --overwrite" in error
    ok("odometry", tiny_drive, "-o", killed, "--residual", "none", "--overwrite")
    assert not partial_folder(killed).exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--residual", "none"), "with other settings (residual)"),
        (("--frames", ":20"), "of another recording, or of other frames"),
        (("--vertical-angle", "0.3"), "is of other scans"),
    ],
)
def test_another_recording_or_other_settings_are_refused(
    words: tuple[str, ...], said: str, killed: Path, tiny_drive: Path
) -> None:
    before = (partial_folder(killed) / JOURNAL).read_bytes()
    assert said in refused(2, "odometry", tiny_drive, "-o", killed, "--resume", *words)
    assert (partial_folder(killed) / JOURNAL).read_bytes() == before


def test_another_version_is_refused(killed: Path, sequence: Sequence, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hybridlio.runs.unfinished.identity.__version__", "99")
    with pytest.raises(ConfigError, match=r"by hybridlio .*, not 99"):
        resume_run(partial_folder(killed), sequence, Config(), Odometry())


def test_there_may_be_nothing_to_resume(tmp_path: Path, tiny_drive: Path, finished_run: Path) -> None:
    assert "holds no unfinished run" in refused(2, "odometry", tiny_drive, "-o", tmp_path / "new", "--resume")
    assert "holds a finished run" in refused(2, "odometry", tiny_drive, "-o", finished_run, "--resume")
    assert "--resume needs -o" in refused(2, "odometry", tiny_drive, "--resume")


def test_an_interrupted_run_goes_on_too(
    tmp_path: Path, tiny_drive: Path, finished_run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(keeper_module, "_BLOCK_SCANS", 4)
    step = Odometry.step

    def interrupted(self: Odometry, frame: Frame) -> Estimate:
        if frame.index == 15:
            raise KeyboardInterrupt
        return step(self, frame)

    monkeypatch.setattr(Odometry, "step", interrupted)
    assert run("odometry", tiny_drive, "-o", tmp_path / "run").exit_code == 130
    assert len(read_tum(tmp_path / "run" / POSES)) == 15
    monkeypatch.setattr(Odometry, "step", step)
    assert "or --resume" in refused(2, "odometry", tiny_drive, "-o", tmp_path / "run")
    ok("odometry", tiny_drive, "-o", tmp_path / "run", "--resume")
    assert contents(tmp_path / "run") == contents(finished_run)


def full_after(blocks: int) -> Callable[..., None]:
    """Return a function that appends a number of blocks to journals, then reports a full disk in the middle of one."""
    append, left = journal.append_block, [blocks]

    def append_block(file: Any, block: bytes) -> None:
        if left[0] == 0:
            file.write(block[: len(block) // 2])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        left[0] -= 1
        append(file, block)

    return append_block


def test_a_full_disk_stops_the_run_and_loses_nothing(
    tmp_path: Path, sequence: Sequence, monkeypatch: pytest.MonkeyPatch, finished_run: Path, tiny_drive: Path
) -> None:
    part = partial_folder(tmp_path / "run")
    with monkeypatch.context() as patch:
        for name, value in {"_BLOCK_SCANS": 4, "_BLOCK_S": 1e9, "_STATE_SHARE": 1e9}.items():
            patch.setattr(keeper_module, name, value)
        patch.setattr(journal, "append_block", full_after(8))  # the header, three blocks with states, and a block
        stopped = Run(sequence, Odometry())
        with Keeper(part, stopped, Config()) as keeper:
            finish_run(stopped, keeper=keeper)
    assert "No space left on device; make room there, then --resume goes on" in str(stopped.stopped)
    kept = read_kept(part)
    assert kept is not None
    assert len(kept.estimates) == 16
    ok("odometry", tiny_drive, "-o", tmp_path / "run", "--resume")
    assert contents(tmp_path / "run") == contents(finished_run)


def test_a_run_is_at_most_fifty_scans_or_a_second_behind(
    tmp_path: Path, sequence: Sequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, behind, late_s = Run(sequence, Odometry(residual="none")), [], []
    monkeypatch.setattr(keeper_module, "_BLOCK_S", 0.05)

    class Watched(Keeper):
        def see(self, frame: Frame) -> None:
            super().see(frame)
            time.sleep(0.01)

        def after_scan(self) -> None:
            super().after_scan()
            behind.append(len(run.estimates) - self._rows)
            late_s.append(time.perf_counter() - self._written_s)

    with Watched(tmp_path, run, Config(residual="none")) as keeper:
        finish_run(run, keeper=keeper)
    assert max(behind) <= keeper_module._BLOCK_SCANS
    assert max(late_s) < 0.5  # 0.05 s, and what a busy machine adds
    kept = read_kept(tmp_path)
    assert kept is not None
    assert [e.pose.tolist() for e in kept.estimates] == [e.pose.tolist() for e in run.estimates]


def test_a_resumed_run_counts_the_time_and_the_scans_before(killed: Path, tiny_drive: Path) -> None:
    sequence = open_sequence(tiny_drive)
    run, length = resume_run(partial_folder(killed), sequence, Config(), Odometry())
    assert run.done == len(run.estimates) == len(run.reading_s) == 15
    assert run.seconds > 0
    assert length <= (partial_folder(killed) / JOURNAL).stat().st_size


def test_damaged_files_are_named(killed: Path, tiny_drive: Path) -> None:
    part = partial_folder(killed)
    with (part / STATE).open("wb") as file:
        journal.append_block(file, b"something else")
    error = refused(2, "odometry", tiny_drive, "-o", killed, "--resume")
    assert f"{STATE}: written by another version of hybridlio, or damaged" in error
