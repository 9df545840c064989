"""Damaged recordings in every layout: a result, or one clear error; ``make fuzz`` runs thousands of mutations."""

from __future__ import annotations

import importlib.util
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from fuzz_corpus import CORPORA, MOST_BYTES
from fuzz_input import Input
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
    assert sum(result.counts.values()) == 60
    assert result.counts["error"] > 5
    kinds = {failure.partition(": ")[2] for failure in result.failures}
    assert any("ends with -9" in kind for kind in kinds)
    assert any("ValueError: raw" in kind for kind in kinds)


def test_the_corpora_are_small_and_of_inputs_that_there_are() -> None:
    for folder in CORPORA.iterdir():
        assert folder.name in INPUTS
        assert sum(path.stat().st_size for path in folder.iterdir()) <= 20 * MOST_BYTES
