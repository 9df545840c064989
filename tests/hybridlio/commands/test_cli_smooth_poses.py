"""``hybridlio smooth --poses``: another odometry with raw samples, fixes and wheel speeds, from plain files."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from command_line import ok, refused
from odometry_files import ANTENNA_M, IMU_LATE_S, write_files

pytestmark = pytest.mark.usefixtures("plain_logging", "without_pages")


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_files(tmp_path_factory.mktemp("files"))


def test_the_command_of_the_help_smooths_plain_files(files: Path, tmp_path: Path) -> None:
    given = ("--poses", files / "odom.txt", "--imu", files / "imu.csv", "--gps", files / "gps.csv")
    further = ("--calibration", files / "c.yaml", "--calibrate", "time_offset,lever_arm", "--max-shift", 0)
    reference = ("--reference", files / "truth.txt", "-o", tmp_path / "out")
    output = ok("smooth", *given, *further, *reference)
    assert "χ² per component: odometry" in output
    metrics = json.loads((tmp_path / "out/metrics.json").read_text())
    assert metrics["ate_m"] < 0.1  # of odometry that is half a metre off
    found = metrics["calibration"]
    assert found["imu_time_offset_s"] == pytest.approx(-IMU_LATE_S, abs=0.01)
    sigmas = np.array(found["parameters"]["lever_arm"]["sigmas"])
    assert (np.abs(found["antenna_imu_m"] - ANTENNA_M) < 3.5 * sigmas).all()
    assert sigmas.max() < 0.3  # of 2 m before
    assert any("IMU clock: stamps moved by" in note for note in metrics["notes"])
    assert (tmp_path / "out/poses_tum.txt").is_file()


def test_wheel_speeds_are_reported(files: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    given = ("--poses", files / "odom.txt", "--imu", files / "imu.csv", "--wheels", files / "wheels.csv")
    output = ok("smooth", *given, "--calibration", files / "c.yaml", "-o", out)
    assert "wheels: " in output
    assert "m/s RMSE" in output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "give a run folder, or poses of another odometry with --poses"),
        (("--poses", "odom.txt"), "with --poses give the folder to write to with -o"),
        (("--poses", "odom.txt", "gps.csv", "-o", "out"), "with --poses: --gps FILE names the CSV file of fixes"),
        (("--poses", "odom.txt", "--gps", "-o", "out"), "with --poses: --gps FILE names the CSV file of fixes"),
        (("--poses", "odom.txt", "--imu", "none.csv", "-o", "out"), "none.csv: cannot be read"),
        (("--poses", "odom.txt", "--gps", "none.csv", "-o", "out"), "none.csv: no such file of GPS fixes"),
        (("--poses", "odom.txt", "--calibration", "none.yaml", "-o", "out"), "none.yaml: no such calibration.yaml"),
        (("run", "--imu", "imu.csv"), "--stamps, --imu, --calibration and --reference belong to --poses"),
        (("--poses", "odom.txt", "--sideways", "0.1", "-o", "out"), "give --wheels too"),
    ],
)
def test_what_does_not_fit_together_is_named(
    files: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], message: str
) -> None:
    monkeypatch.chdir(files)
    assert message in refused(2, "smooth", *arguments)


def test_a_kitti_file_needs_stamps_and_gives_lidar_poses(files: Path, tmp_path: Path) -> None:
    assert "KITTI's format has no times" in refused(2, "smooth", "--poses", files / "kitti.txt", "-o", tmp_path / "out")
    given = ("--poses", files / "kitti.txt", "--stamps", files / "times.txt", "--imu", files / "imu.csv")
    ok("smooth", *given, "--calibration", files / "c.yaml", "-o", tmp_path / "out")
    assert yaml.safe_load((files / "c.yaml").read_text())["T_imu_lidar"]
