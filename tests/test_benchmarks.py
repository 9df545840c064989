"""The benchmarks run; what they measure is not tested."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from hybridlio.config import Config

ROOT = Path(__file__).resolve().parents[1]
OURS = f"{Config().initial_pose} + none + {Config().backend}"


def run(script: str, *words: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(ROOT / "benchmarks" / script), *map(str, words)]
    return subprocess.run(
        command, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True, check=False
    )


def test_peers_are_compared_with_ours_as_far_as_they_are_installed(tiny_drive, tmp_path):
    options = ("--frames", ":6", "--residual", "none", "--peers", "kiss-icp,rko_lio,small_gicp", "--repeats", "2")
    done = run("peers.py", tiny_drive, *options, "-o", tmp_path)
    assert done.returncode == 0, done.stderr
    ((told,),) = [json.loads((tmp_path / "peers.json").read_text())["recordings"].values()]
    assert told["scans"] == 6
    (first, ours), *peers = told["systems"].items()
    assert first == OURS
    assert ours["times ours"] == 1
    for name, row in told["systems"].items():
        assert row["median [ms]"] > 0
        assert row["least"] <= row["times ours"] <= row["most"]
        assert row["start to first pose [s]"] > 0
        assert row["peak memory [MB]"] > 10
        assert name in (tmp_path / "peers.md").read_text()
    for peer in ("kiss-icp", "rko_lio"):
        assert peer in dict(peers) or f"{peer} is not installed" in done.stdout
    assert "small_gicp" in dict(peers)


def test_hard_cases_are_held_against_the_normal_one(tmp_path):
    options = ("--scenarios", "imu-gap", "--seeds", "3", "--length-m", "12", "--peers", "small_gicp")
    done = run("scenarios.py", tmp_path / "drives", *options, "--residual", "none", "-o", tmp_path)
    assert done.returncode == 0, done.stderr
    told = json.loads((tmp_path / "scenarios.json").read_text())["scenarios"]
    assert set(told) == {"normal", "imu-gap"}
    for systems in told.values():
        ours = systems[OURS][0]
        assert ours["completed"]
        assert ours["end_sigma_m"] > 0
        assert "end_sigma_m" not in systems["small_gicp"][0]
    assert "small_gicp" in (tmp_path / "imu-gap.md").read_text()
