"""The notebooks run as a user would run them, and become pages and valid ``.ipynb`` files."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import bags
import pytest
from streams import thinned

import hybridlio as hl
from docs.notebooks import ipynb, notebooks, page

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "examples" / "notebooks"


def run_notebook(name: str, folder: Path) -> str:
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, str(FOLDER / name)]
    done = subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def numbers(text: str, pattern: str) -> list[float]:
    return [float(number) for number in re.findall(pattern, text)]


def test_a_bag_becomes_a_map(tiny_drive: Path, tmp_path: Path) -> None:
    messages, drive = bags.Messages(True), hl.open_sequence(tiny_drive).part(0, 12)
    scans = (thinned(drive, 4).load_scan(k) for k in range(len(drive)))
    imu = drive.imu.between(0, int(drive.stamps_ns[-1]) + 10**7)
    content = bags.drive_messages(messages, scans, imu, drive.calibration.T_imu_lidar)
    bags.write(tmp_path / "ride", messages, content, "mcap")
    run_notebook("bag_to_map.py", tmp_path)
    assert (tmp_path / "map.ply").stat().st_size > 10_000


def test_initial_poses_are_swapped(tmp_path: Path) -> None:
    errors_cm = numbers(run_notebook("swap_initial_poses.py", tmp_path), r"(\d+\.\d+) cm")
    assert len(errors_cm) == 4
    assert max(errors_cm) < 30


def test_a_factor_of_ones_own_moves_the_pose(tmp_path: Path) -> None:
    text = run_notebook("own_factor.py", tmp_path)
    (before_m, measured_m), (residual_m,) = (
        numbers(text, r"(\d+\.\d+) m (?:before|meas)"),
        numbers(text, r"(\S+) m after"),
    )
    assert abs(residual_m) < 0.1 * abs(before_m - measured_m)


def test_gps_takes_the_growing_turn_out_of_other_poses(tmp_path: Path) -> None:
    alone_m, with_gps_m = numbers(run_notebook("smooth_kiss_icp_with_gps.py", tmp_path), r"ATE (\d+\.\d+) m")
    assert with_gps_m < alone_m


def test_weights_of_own_data_are_used(tmp_path: Path) -> None:
    assert "20 scans by the new weights" in run_notebook("train_on_own_data.py", tmp_path)


def test_a_second_drive_is_localised_in_the_first(tmp_path: Path) -> None:
    (held,) = numbers(run_notebook("localise.py", tmp_path), r"held (\d+) %")
    assert held > 90


def test_every_notebook_is_tested_and_in_the_navigation() -> None:
    tested = re.findall(r'run_notebook\("(\w+)\.py"', Path(__file__).read_text())
    assert sorted(tested) == sorted(notebooks())
    navigation = (ROOT / "mkdocs.yml").read_text()
    assert [name for name in notebooks() if f"notebooks/{name}.md" not in navigation] == []


@pytest.mark.parametrize("name", notebooks())
def test_a_notebook_begins_with_its_title_and_keeps_every_line_of_its_code(name: str) -> None:
    nbformat = pytest.importorskip("nbformat", reason="nbformat, which Open3D brings, checks notebooks")
    content = notebooks()[name]
    assert content[0][1].startswith("# ")
    notebook = json.loads(ipynb(content))
    nbformat.validate(notebook)
    code = ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    compile("\n".join(code), name, "exec")
    lines = [line for line in (FOLDER / f"{name}.py").read_text().splitlines() if line and not line.startswith("#")]
    assert [line for line in lines if line not in "\n".join(code)] == []
    assert all(block in page(name, content) for block in code)
