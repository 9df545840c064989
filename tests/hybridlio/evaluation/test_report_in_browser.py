"""The report in a real browser, offline: every chart is drawn, and nothing is logged to the console."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.trajectory import Trajectory
from hybridlio.evaluation.report import ReportData, write_report

BROWSER = shutil.which("chromium") or shutil.which("google-chrome") or shutil.which("chromium-browser")


@pytest.fixture
def page(tmp_path: Path) -> Path:
    stamps = np.arange(200, dtype=np.int64) * 100_000_000
    steps = se3.exp(np.tile([0, 0, 0.01, 0.5, 0, 0], (199, 1)))
    poses = [np.eye(4)]
    for step in steps:
        poses.append(poses[-1] @ step)
    covariances = np.eye(6) * np.linspace(1e-6, 1e-3, 200)[:, None, None]
    reference = Trajectory(stamps, np.array(poses) @ se3.exp(np.random.default_rng(0).normal(0, 1e-3, (200, 6))))
    points = np.random.default_rng(1).normal(0, 30, (2000, 3))
    data = ReportData("page", Trajectory(stamps, np.array(poses), covariances), reference, map_points=points)
    write_report(tmp_path / "report.html", data)
    return tmp_path / "report.html"


@pytest.mark.skipif(BROWSER is None, reason="no Chromium or Chrome to open the page with")
def test_the_page_draws_its_charts_without_an_error(page: Path, tmp_path: Path) -> None:
    assert BROWSER is not None
    words = [BROWSER, "--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr"]
    words += ["--window-size=1280,6000", "--virtual-time-budget=20000", f"--user-data-dir={tmp_path / 'profile'}"]
    done = subprocess.run(
        [*words, "--dump-dom", page.as_uri()], capture_output=True, text=True, timeout=120, check=True
    )
    assert not re.findall(r"CONSOLE.*", done.stderr)
    drawn = [tag for tag in re.findall(r"<figure[^>]*>", done.stdout) if "js-plotly-plot" in tag]
    names = {name for tag in drawn for name in re.findall(r'data-chart="(\w+)"', tag)}
    assert {"map", "timeline"} <= names  # the others are drawn when they come into view
