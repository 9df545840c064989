"""Damaged recordings in every layout: a result, or one clear error; ``make fuzz`` runs thousands of mutations."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "fuzz_readers.py"


@pytest.mark.parametrize("reader", ["folder", "rosbag-lz4", "nuscenes"])
def test_damaged_recordings_give_a_result_or_one_error(reader: str) -> None:
    run = subprocess.run([sys.executable, SCRIPT, reader, "--count", "10"], capture_output=True, text=True)
    assert run.returncode == 0, run.stdout + run.stderr
    assert "10 mutations from seed 0" in run.stdout
    assert ", 0 failed" in run.stdout
