"""The command line as a process: interrupts, start-up time and help."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from typer.testing import CliRunner

from hybridlio.commands.app import app
from hybridlio.core.lidar_models import LIDAR_MODELS
from hybridlio.datasets.registry import READERS
from hybridlio.odometry.registry import BACKENDS, INITIAL_POSE_SOURCES, RESIDUAL_SOURCES
from hybridlio.simulation.platforms.bodies import BODIES
from hybridlio.simulation.platforms.imu_grades import IMU_GRADES
from hybridlio.simulation.platforms.lidars import SCANNERS
from hybridlio.simulation.platforms.scenes.table import SCENES

HEAVY = {"torch", "gtsam", "open3d", "matplotlib", "small_gicp", "scipy", "numpy", "pydantic"}
INTERRUPTED = """
import os, signal, sys
from hybridlio.odometry.odometry import Odometry
name = sys.argv.pop(1)
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore SIGINT
step = Odometry.step
def interrupted(self, frame):
    if frame.index == 8:
        os.kill(os.getpid(), getattr(signal, name))
    return step(self, frame)
Odometry.step = interrupted
import hybridlio.runs.write
hybridlio.runs.write.write_pages = lambda *_: None
from hybridlio.commands.app import app
app()
"""


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_an_interrupted_process_writes_its_estimates(name, tiny_drive, project_root, tmp_path):
    words = [name, "odometry", str(tiny_drive), "--residual", "none", "-o", str(tmp_path / "run")]
    env = {**os.environ, "PYTHONPATH": str(project_root)}
    command = [sys.executable, "-c", INTERRUPTED, *words]
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=False, restore_signals=True)
    assert done.returncode == 130, done.stderr
    assert "Traceback" not in done.stderr
    assert "wrote 8 of 25 scans" in done.stderr
    metrics = json.loads((tmp_path / "run/metrics.json").read_text())
    assert (metrics["frames_done"], metrics["frames"], metrics["interrupted"]) == (8, 25, True)
    with np.load(tmp_path / "run/odometry.npz") as record:
        assert len(record["online_poses"]) == 8


@pytest.mark.parametrize(
    "words", [["--version"], ["--help"], ["odometry", "--help"], ["compare", "--help"], ["train", "--help"]]
)
def test_help_and_version_load_no_heavy_library(words, project_root):
    code = (
        f"import sys; from hybridlio.commands.app import app; sys.argv[1:] = {words!r}\n"
        "try: app()\nexcept SystemExit as end: print(end.code, *sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=project_root, capture_output=True, text=True, check=True)
    status, *modules = done.stdout.splitlines()[-1].split()
    assert status == "0"
    assert not HEAVY & set(modules)


@pytest.mark.parametrize(
    ("command", "names"),
    [
        ("odometry", {**INITIAL_POSE_SOURCES, **RESIDUAL_SOURCES, **BACKENDS, **READERS}),
        ("compare", {**INITIAL_POSE_SOURCES, **RESIDUAL_SOURCES, **BACKENDS}),
        ("simulate", {**LIDAR_MODELS, **SCENES, **BODIES, **SCANNERS, **IMU_GRADES}),
    ],
)
def test_help_lists_all_choices(command, names):
    text = " ".join(CliRunner().invoke(app, [command, "--help"], env={"COLUMNS": "200", "TERM": "dumb"}).stdout.split())
    assert [name for name in names if name not in text] == []
