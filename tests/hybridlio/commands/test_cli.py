"""The command line: from simulation to smoothing, settings, and errors."""

import errno
import json
from pathlib import Path

import pytest
from command_line import ok, refused, run

import hybridlio
from hybridlio.core.trajectory import read_tum
from hybridlio.datasets.registry import open_sequence
from hybridlio.odometry.config import Config, parse_config
from hybridlio.runs.folder import FILES

pytestmark = pytest.mark.usefixtures("plain_logging")


def test_simulation_odometry_smoothing_evaluation_and_view_work_together(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    drive = Path(ok("simulate", "town", "--seconds", "1.2", "--lidar", "16-beam").splitlines()[-1])
    assert drive.is_dir()
    text = ok("odometry", "town")
    assert "12 scans" in text
    folder = Path("runs/latest").resolve()
    assert folder.name.startswith("2026_01_01_drive_0001-")
    assert str(Path("runs") / folder.name / "report.html") in text
    assert sorted(path.name for path in folder.iterdir()) == sorted(FILES)
    assert "smoothed" in ok("smooth", "runs/latest")
    smoothed = read_tum(folder / "smoothed/poses_tum.txt")
    assert smoothed.stamps_ns.tolist() == open_sequence(drive).stamps_ns.tolist()
    for path in ("runs/latest", "runs/latest/smoothed"):
        assert "ATE [m]" in ok("evaluate", path)
        assert ok("view", path, "--report").strip().endswith("report.html")


def test_simulating_again_keeps_the_drive_and_other_settings_are_an_error(tiny_drive):
    root, same = tiny_drive.parent.parent, ("--seconds", 2.5, "--seed", 3, "--lidar", "16-beam")
    stamp = (tiny_drive / "poses.txt").stat().st_mtime_ns
    ok("simulate", root, *same)
    assert (tiny_drive / "poses.txt").stat().st_mtime_ns == stamp
    assert "another" in refused(2, "simulate", root, *same, "--gps")


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (("--lidar", "128-beam"), "--lidar: unknown lidar '128-beam'"),
        (("--speed", "99"), "--speed: "),
        (("--seconds", "-1"), "--seconds: "),
        (("--seconds", "1e9"), "--seconds: "),
        (("--poses", "none.txt"), "none.txt"),
    ],
)
def test_the_error_for_an_invalid_simulation_setting_names_the_option(options, named, tmp_path):
    assert named in refused(2, "simulate", tmp_path, *options)


def test_the_printed_configuration_can_be_edited_and_used(tiny_drive, tmp_path, without_pages):
    text = ok("config")
    import yaml

    assert parse_config(yaml.safe_load(text), "printed") == Config()
    changed = tmp_path / "my.yaml"
    changed.write_text(text.replace("residual: scan-matching", "residual: none"))
    ok(
        "odometry",
        tiny_drive,
        "--config",
        changed,
        "--initial-pose",
        "identity",
        "--frames",
        ":5",
        "-o",
        tmp_path / "r",
    )
    metrics = json.loads((tmp_path / "r/metrics.json").read_text())
    assert (metrics["initial_pose"], metrics["residual"]) == ("identity", "none")
    changed.write_text(text.replace("residual:", "residul:"))
    assert "residul" in refused(2, "odometry", tiny_drive, "--config", changed, "-o", tmp_path / "s")


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (("odometry", "nowhere"), "nowhere"),
        (("odometry", "DRIVE", "--initial-pose", "guess"), "'guess'; choose one of"),
        (("odometry", "DRIVE", "--residual", "guess"), "'guess'"),
        (("odometry", "DRIVE", "--backend", "guess"), "'guess'"),
        (("odometry", "DRIVE", "--sequence", "7"), "'7'"),
        (("odometry", "DRIVE", "--reader", "rosbags"), "'rosbags'"),
        (("odometry", "DRIVE", "--frames", "x"), "'x'"),
        (("odometry", "nowhere", "--frames", "x"), "'x'"),  # checked before the recording is opened
        (("odometry", "DRIVE", "--config", "none.yaml"), "none.yaml"),
        (("compare", "DRIVE", "--initial-pose", "kalman,guess"), "'guess'"),
        (("compare", "DRIVE", "--residual", ","), "no name given"),
        (("smooth", "DRIVE"), "not a run folder"),
        (("evaluate", "nowhere", "--reference", "DRIVE"), "nowhere"),
        (("view", "DRIVE", "--report"), "report.html"),
    ],
)
def test_unusable_input_prints_one_line_and_writes_nothing(words, named, tiny_drive, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert named in refused(2, *(tiny_drive if word == "DRIVE" else word for word in words))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("flag", "level"), [("-v", "info"), ("-vv", "debug")])
def test_verbose_prints_more_to_stderr(flag, level, tiny_drive, tmp_path, without_pages):
    quiet = run("odometry", tiny_drive, "--residual", "none", "--frames", ":4", "-o", tmp_path / "a")
    loud = run("odometry", tiny_drive, "--residual", "none", "--frames", ":4", "-o", tmp_path / "b", flag)
    assert f"{level}: " in loud.stderr
    assert f"{level}: " not in quiet.stderr
    assert ("frame 3" in loud.stderr) == (flag == "-vv")


def test_an_unexpected_error_prints_its_traceback_only_with_vv(tiny_drive, tmp_path, monkeypatch):
    def fail(*_):
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr("hybridlio.odometry.config.config_to_yaml", fail)
    assert "ZeroDivisionError: a bug" in refused(1, "config")
    for words in (("-vv", "config"), ("config", "-vv")):
        result = run(*words)
        assert result.exit_code == 1
        assert "Traceback" in result.stderr


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (PermissionError(errno.EACCES, "Permission denied", "/root/map"), "error: /root/map: Permission denied"),
        (OSError(errno.ENOSPC, "No space left on device"), "error: No space left on device"),
        (MemoryError(), "error: out of memory"),
    ],
)
def test_errors_of_the_system_are_not_reported_as_bugs(error, message, monkeypatch):
    def fail(*_):
        raise error

    monkeypatch.setattr("hybridlio.odometry.config.config_to_yaml", fail)
    assert message in (words := refused(1, "config"))
    assert "bug" not in words


def test_progress_is_printed_to_stderr_only(tiny_drive, tmp_path, without_pages):
    result = run("odometry", tiny_drive, "--residual", "none", "-o", tmp_path / "run")
    assert "25/25 scans (100 %)" in result.stderr
    assert "(100 %)" not in result.stdout


def test_version_prints_the_package_version():
    assert ok("--version").split() == ["hybridlio", hybridlio.__version__]
