"""Damaged recordings in every layout: a result, or one clear error; ``make fuzz`` runs thousands of mutations."""

from __future__ import annotations

import importlib.util
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from fuzz_corpus import CORPORA, MOST_BYTES, Corpus
from fuzz_input import Input, outcome
from fuzz_inputs import INPUTS

from hybridlio.core.errors import DataError

SCRIPT = Path(__file__).resolve().parents[2] / "fuzz_readers.py"


@pytest.mark.parametrize("reader", ["folder", "rosbag-lz4", "nuscenes"])
def test_damaged_recordings_give_a_result_or_one_error(reader: str) -> None:
    run = subprocess.run([sys.executable, SCRIPT, reader, "--count", "10"], capture_output=True, text=True)
    assert run.returncode == 0, run.stdout + run.stderr
    assert "10 mutations from seed 0" in run.stdout
    assert ", 0 failed" in run.stdout


def test_a_reader_that_ends_the_process_or_raises_anything_else_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    def write(root: Path) -> Path:
        root.mkdir()
        (root / "file").write_bytes(bytes(range(100)))
        return root / "file"

    def read(path: Path) -> None:
        content = path.read_bytes() if path.exists() else b""
        if len(content) > 100:
            os.kill(os.getpid(), signal.SIGKILL)
        if len(content) == 100 and content != bytes(range(100)):
            raise ValueError("raw")
        if len(content) < 100:
            raise DataError("too short")

    spec = importlib.util.spec_from_file_location("fuzz_readers", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    fuzz = importlib.util.module_from_spec(spec)
    sys.modules["fuzz_readers"] = fuzz  # workers find their function by its module
    spec.loader.exec_module(fuzz)
    monkeypatch.setitem(INPUTS, "bad", Input(write, read))
    result = fuzz.run("bad", 0, 60, None)
    of_cases = [failure for failure in result.failures if failure.startswith("case ")]
    assert any("twice: the process ends with -9" in failure for failure in of_cases)
    assert sum(result.counts.values()) == 60 + len(of_cases)
    assert result.counts["error"] > 5
    kinds = {failure.partition(": ")[2] for failure in result.failures}
    assert any("ends with -9" in kind for kind in kinds)
    assert any("ValueError: raw" in kind for kind in kinds)


def test_the_corpora_are_small_and_of_inputs_that_there_are() -> None:
    for folder in CORPORA.iterdir():
        assert folder.name in INPUTS
        assert sum(path.stat().st_size for path in folder.iterdir()) <= 20 * MOST_BYTES


def test_an_unknown_reader_is_named_in_one_line() -> None:
    run = subprocess.run([sys.executable, SCRIPT, "folder", "nothing"], capture_output=True, text=True)
    assert run.returncode == 2
    assert "no reader is named 'nothing'; there are kitti-raw, " in run.stderr.splitlines()[-1]


def test_every_kind_of_file_has_cases_that_differ_from_it(tmp_path: Path) -> None:
    (tmp_path / "a.bin").write_bytes(bytes(range(200)))
    (tmp_path / "b.txt").write_text("1 2 3\n")
    corpus = Corpus("none that is kept", tmp_path)
    cases = corpus.cases()
    assert {case[0] for case in cases.values()} == {0, 1}
    for case in cases.values():
        with corpus.applied(case):
            assert (tmp_path / ["a.bin", "b.txt"][case[0]]).read_bytes() == case[1:]
    assert (tmp_path / "a.bin").read_bytes() == bytes(range(200))


def test_computing_for_too_long_is_seen_and_waiting_for_a_busy_machine_is_not() -> None:
    def compute(until_s: float) -> None:
        while time.process_time() < until_s:
            pass

    assert outcome(compute, time.process_time() + 5, limit_s=0.1) == "takes over 0.1 s"
    assert outcome(time.sleep, 0.3, limit_s=0.1) == "ok"
