"""Run every example as a user would, on a short drive."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import bags
import pytest
from streams import thinned

import hybridlio as hl

ROOT = Path(__file__).resolve().parents[1]


def run_example(name: str, folder: Path) -> str:
    command = [sys.executable, str(ROOT / "examples" / name), str(folder), "1.5"]
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Return one folder for all examples, which use the same simulated drive."""
    return tmp_path_factory.mktemp("examples")


def metres(text: str) -> list[float]:
    return [float(number) for number in re.findall(r"(\d+\.\d+) m\b", text)]


def test_odometry_from_python_ends_within_centimetres(folder):
    length_m, off_m, sigma_m = metres(run_example("odometry_from_python.py", folder))
    assert length_m > 5
    assert off_m < 0.1
    assert 0 < sigma_m < 1


def test_a_user_defined_initial_pose_source_works(folder):
    text = run_example("own_initial_pose_source.py", folder)
    assert "wheels-and-gyroscope" in text
    wheels_m, _ = metres(text)
    assert wheels_m < 0.1


def test_initial_pose_sources_are_swapped_by_name(folder):
    text = run_example("swap_initial_pose.py", folder)
    lines = dict(line.split(": ", 1) for line in text.splitlines())
    assert list(lines) == ["preintegration", "lstm", "kalman", "constant-velocity"]
    for line in lines.values():
        initial_m, end_m = metres(line)
        assert 0 < initial_m < 0.3
        assert end_m < 0.1


def test_a_pose_graph_closes_its_loop_and_rejects_the_wrong_one(folder):
    text = run_example("pose_graph_by_hand.py", folder)
    alone_m, _, closed_m, sigma_m = metres(text)
    assert closed_m < 3 * sigma_m < alone_m
    assert "only the wrong loop: True" in text
    assert (folder / "square.g2o").is_file()


def test_a_g2o_file_is_solved_and_written(folder):
    text = run_example("solve_g2o.py", folder)
    before, after = (float(number) for number in re.findall(r"error (\S+) -> (\S+)", text)[0])
    assert after < before
    assert (folder / "spiral-solved.g2o").is_file()


def test_a_finished_run_is_smoothed_and_its_error_falls(folder):
    text = run_example("smooth_run.py", folder)
    before, after = (float(number) for number in re.findall(r"error (\S+) -> (\S+) in", text)[0])
    assert after < before
    assert (folder / "odometry.npz").is_file()


def test_a_bag_is_streamed_at_real_speed(tiny_drive, tmp_path):
    messages, drive = bags.Messages(True), hl.open_sequence(tiny_drive).part(0, 12)
    scans = (thinned(drive, 4).load_scan(k) for k in range(len(drive)))
    end_ns = int(drive.stamps_ns[-1]) + 10**7
    content = bags.drive_messages(messages, scans, drive.imu.between(0, end_ns), drive.calibration.T_imu_lidar)
    text = run_example("stream_bag.py", bags.write(tmp_path / "bag", messages, content, "mcap"))
    assert "12 estimates of 12 scans" in text
    assert 0 < float(re.findall(r"median (\d+) ms", text)[0]) < 5000


def test_gps_with_an_outage_is_fused_and_georeferenced(folder):
    text = run_example("gps_outage.py", folder)
    without_m, with_m, outage_m = metres(text)[:3]
    assert with_m < without_m
    assert outage_m < without_m
    assert ", 1 rejected" in text
    assert (folder / "georeferenced.geojson").is_file()


def test_every_example_is_tested():
    named = re.findall(r'run_example\("(\w+\.py)"', Path(__file__).read_text())
    assert sorted(set(named)) == sorted(path.name for path in (ROOT / "examples").glob("*.py"))
