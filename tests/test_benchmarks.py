"""The benchmarks run; what they measure is not tested."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def test_peers_are_compared_with_ours_as_far_as_they_are_installed(tiny_drive, tmp_path):
    command = [
        sys.executable,
        str(ROOT / "benchmarks/peers.py"),
        str(tiny_drive),
        "--frames",
        ":12",
        "--residual",
        "none",
    ]
    done = subprocess.run(
        [*command, "--repeats", "2", "-o", str(tmp_path)],
        env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    said = json.loads((tmp_path / "peers.json").read_text())
    assert said["scans"] == 12
    assert said["systems"][0]["system"] == "preintegration + none"
    assert said["systems"][0]["times ours"] == 1
    for row in said["systems"]:
        assert row["median [ms]"] > 0
        assert row["system"] in (tmp_path / "peers.md").read_text()
    for peer in ("kiss-icp", "rko_lio"):
        assert any(row["system"] == peer for row in said["systems"]) or f"{peer} is not installed" in done.stdout
