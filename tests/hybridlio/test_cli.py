import errno
import json
import logging
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

import hybridlio
from hybridlio.cli import app
from hybridlio.config import Config, parse_config
from hybridlio.datasets.registry import open_sequence
from hybridlio.keyframes import Keyframes
from hybridlio.run_folder import FILES
from hybridlio.trajectory_files import read_tum


@pytest.fixture(autouse=True)
def plain_logging():
    """The commands set the library's logger up; leave it as other tests expect it."""
    yield
    logger = logging.getLogger("hybridlio")
    logger.handlers.clear()
    logger.setLevel(logging.NOTSET)
    logger.propagate = True


def run(*words: object) -> Result:
    return CliRunner().invoke(app, [str(word) for word in words], env={"COLUMNS": "200", "TERM": "dumb"})


def ok(*words: object) -> str:
    result = run(*words)
    assert result.exit_code == 0, result.output
    return result.stdout


def refused(code: int, *words: object) -> str:
    """The one line that a command ends with."""
    result = run(*words)
    assert result.exit_code == code, result.output
    assert "Traceback" not in result.output
    (line,) = [line for line in result.stderr.splitlines() if line.startswith("error: ")]
    return line


@pytest.fixture
def without_pages(monkeypatch) -> None:
    """Spare the test the report and its pictures, which take a second."""
    monkeypatch.setattr("hybridlio.run_outputs.write_pages", lambda *_: None)


@pytest.fixture(scope="module")
def run_folder(tiny_drive, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("cli") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hybridlio.run_outputs.write_pages", lambda *_: None)
        ok("odometry", tiny_drive, "-o", folder)
    return folder


def test_the_whole_job_from_simulation_to_smoothing(tmp_path, monkeypatch):
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
        assert ok("view", path).strip().endswith("report.html")


def test_the_learned_front_end_runs_without_a_graph_and_can_be_smoothed(tiny_drive, untrained_weights, tmp_path):
    config, folder = tmp_path / "learned.yaml", tmp_path / "run"
    learned = f"{{weights: {untrained_weights}, device: cpu}}"
    config.write_text(f"initial_pose: lstm\nresidual: network\nbackend: none\nlstm: {learned}\nnetwork: {learned}\n")
    ok("odometry", tiny_drive, "--config", config, "--frames", ":8", "-o", folder)
    assert sorted(path.name for path in folder.iterdir()) == sorted(FILES)
    assert json.loads((folder / "metrics.json").read_text())["backend"] == "none"
    assert "smoothed" in ok("smooth", folder)


def test_simulating_again_leaves_the_drive_as_it_is_and_other_settings_are_refused(tiny_drive):
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
def test_a_wrong_setting_of_the_simulation_is_named_by_its_option(options, named, tmp_path):
    assert named in refused(2, "simulate", tmp_path, *options)


def test_the_runs_own_reference_and_the_same_in_a_file_or_recording_give_the_same_figures(run_folder, tiny_drive):
    figures = json.loads(ok("evaluate", run_folder, "--json"))
    assert {"t_rel_percent", "r_rel_deg_per_100m", "ate_m", "rpe_m", "step_anees_rotation"} <= set(figures)
    assert figures["ate_m"] < 0.1
    assert figures["poses"] == 25
    for reference in (tiny_drive, tiny_drive / "poses.txt", run_folder / "reference_tum.txt"):
        again = json.loads(ok("evaluate", run_folder, "--reference", reference, "--json"))
        assert again["ate_m"] == pytest.approx(figures["ate_m"], abs=1e-9)
        assert again["anees_position"] == pytest.approx(figures["anees_position"], rel=1e-6)
    for estimate in ("poses_tum.txt", "poses_kitti.txt"):
        again = json.loads(ok("evaluate", run_folder / estimate, "--reference", tiny_drive, "--json"))
        assert again["ate_m"] == pytest.approx(figures["ate_m"], abs=1e-9)
        assert again["anees_position"] is None


def test_drift_over_lengths_asked_for_is_reported(run_folder):
    figures = json.loads(ok("evaluate", run_folder, "--lengths", "5,10", "--json"))
    assert figures["chosen_lengths_m"] == [5, 10]
    for wrong in ("5,x", "0", ""):
        assert "--lengths" in refused(2, "evaluate", run_folder, "--lengths", wrong)


def test_a_file_alone_cannot_be_evaluated(run_folder):
    assert "--reference" in refused(2, "evaluate", run_folder / "poses_tum.txt")


def test_a_run_is_not_overwritten_unasked(run_folder, tiny_drive, tmp_path, without_pages):
    folder = shutil.copytree(run_folder, tmp_path / "run")
    before = (folder / "metrics.json").read_bytes()
    assert "--overwrite" in refused(2, "odometry", tiny_drive, "-o", folder)
    assert (folder / "metrics.json").read_bytes() == before
    ok("odometry", tiny_drive, "-o", folder, "--overwrite", "--residual", "none", "--frames", "0:5")
    assert json.loads((folder / "metrics.json").read_text())["frames"] == 5


def test_a_configuration_is_printed_changed_and_used(tiny_drive, tmp_path, without_pages):
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
        (("odometry", "DRIVE", "--reader", "rosbag"), "'rosbag'"),
        (("odometry", "DRIVE", "--frames", "x"), "'x'"),
        (("odometry", "DRIVE", "--config", "none.yaml"), "none.yaml"),
        (("compare", "DRIVE", "--initial-pose", "kalman,guess"), "'guess'"),
        (("compare", "DRIVE", "--residual", ","), "no name"),
        (("smooth", "DRIVE"), "no run in it"),
        (("evaluate", "nowhere", "--reference", "DRIVE"), "nowhere"),
        (("view", "DRIVE"), "report.html"),
    ],
)
def test_input_that_cannot_be_used_is_one_line_and_leaves_nothing(words, named, tiny_drive, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert named in refused(2, *(tiny_drive if word == "DRIVE" else word for word in words))
    assert list(tmp_path.iterdir()) == []


def test_a_smoothed_run_never_takes_another_runs_place_unasked(run_folder, tmp_path, without_pages):
    other = shutil.copytree(run_folder, tmp_path / "other")
    assert "--overwrite" in refused(2, "smooth", run_folder, "-o", other)
    assert "the run itself" in refused(2, "smooth", run_folder, "-o", run_folder)
    assert (other / "odometry.npz").exists()
    ok("smooth", run_folder, "-o", other, "--overwrite")
    assert not (other / "odometry.npz").exists()


@pytest.mark.parametrize(("flag", "level"), [("-v", "info"), ("-vv", "debug")])
def test_verbose_says_more_on_stderr(flag, level, tiny_drive, tmp_path, without_pages):
    quiet = run("odometry", tiny_drive, "--residual", "none", "--frames", ":4", "-o", tmp_path / "a")
    loud = run("odometry", tiny_drive, "--residual", "none", "--frames", ":4", "-o", tmp_path / "b", flag)
    assert f"{level}: " in loud.stderr
    assert f"{level}: " not in quiet.stderr
    assert ("frame 3" in loud.stderr) == (flag == "-vv")


def test_a_recording_without_inertial_data_goes_on_by_constant_velocity_unless_told_otherwise(
    tiny_drive, tmp_path, without_pages
):
    drive = shutil.copytree(tiny_drive, tmp_path / "date" / tiny_drive.name)
    shutil.rmtree(drive / "oxts")
    result = run("odometry", drive, "-o", tmp_path / "run")
    assert result.exit_code == 0, result.output
    assert "constant-velocity" in result.stderr
    assert json.loads((tmp_path / "run/metrics.json").read_text())["initial_pose"] == "constant-velocity"
    line = refused(2, "odometry", drive, "--initial-pose", "preintegration", "-o", tmp_path / "other")
    assert "IMU" in line
    assert not (tmp_path / "other").exists()


@pytest.fixture
def damaged(tiny_drive, tmp_path) -> Path:
    """The drive with a truncated scan, 7, and a missing one, 12."""
    date = shutil.copytree(tiny_drive.parent, tmp_path / tiny_drive.parent.name)
    scans = date / tiny_drive.name / "velodyne_points/data"
    with (scans / "0000000007.bin").open("r+b") as file:
        file.truncate(1001)
    (scans / "0000000012.bin").write_bytes(b"")
    return date


def test_scans_that_cannot_be_read_are_bridged_told_and_have_rows(damaged, tmp_path):
    result = run("odometry", damaged, "-o", tmp_path / "run")
    assert result.exit_code == 0, result.output
    for name in ("0000000007.bin", "0000000012.bin"):
        assert name in result.stderr
    assert "bridged scans: 7, 12" in result.stdout
    metrics = json.loads((tmp_path / "run/metrics.json").read_text())
    assert metrics["bridged"] == [7, 12]
    assert set(metrics["unreadable"]) == {"7", "12"}
    assert metrics["ate_m"] < 0.2
    assert "0000000007.bin" in (tmp_path / "run/report.html").read_text()
    assert len(read_tum(tmp_path / "run/poses_tum.txt")) == 25


def test_an_error_in_the_middle_keeps_what_was_estimated(tiny_drive, tmp_path, monkeypatch, without_pages):
    from hybridlio.errors import GraphError
    from hybridlio.graph.online import IncrementalBackend

    update = IncrementalBackend.update

    def fail(self, frame, relative):
        if frame.index == 9:
            raise GraphError("frame 9: the graph cannot be solved")
        return update(self, frame, relative)

    monkeypatch.setattr(IncrementalBackend, "update", fail)
    assert "frame 9" in refused(1, "odometry", tiny_drive, "--residual", "none", "-o", tmp_path / "run")
    metrics = json.loads((tmp_path / "run/metrics.json").read_text())
    assert (metrics["frames_done"], metrics["frames"], metrics["interrupted"]) == (9, 25, True)
    assert len(read_tum(tmp_path / "run/poses_tum.txt")) == 9
    ok("smooth", tmp_path / "run")


def test_a_fault_shows_its_traceback_only_when_asked_to(tiny_drive, tmp_path, monkeypatch):
    def fail(*_):
        raise ZeroDivisionError("a fault")

    monkeypatch.setattr("hybridlio.config.config_to_yaml", fail)
    assert "ZeroDivisionError: a fault" in refused(1, "config")
    for words in (("-vv", "config"), ("config", "-vv")):
        result = run(*words)
        assert result.exit_code == 1
        assert "Traceback" in result.stderr


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (PermissionError(errno.EACCES, "Permission denied", "/root/map"), "error: /root/map: Permission denied"),
        (OSError(errno.ENOSPC, "No space left on device"), "error: No space left on device"),
        (MemoryError(), "error: out of memory"),
    ],
)
def test_what_the_system_refuses_is_no_fault_of_the_librarys(error, said, monkeypatch):
    def fail(*_):
        raise error

    monkeypatch.setattr("hybridlio.config.config_to_yaml", fail)
    assert said in (words := refused(1, "config"))
    assert "fault" not in words


def test_a_disk_without_links_keeps_the_run_and_says_so(tiny_drive, tmp_path, monkeypatch, without_pages):
    def fail(*_, **__):
        raise OSError(errno.EPERM, "Operation not permitted")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Path, "symlink_to", fail)
    result = run("odometry", tiny_drive, "--residual", "none", "--frames", ":3")
    assert result.exit_code == 0, result.output
    assert "latest cannot be made a link" in result.stderr
    assert len(list((tmp_path / "runs").glob("*/metrics.json"))) == 1


def test_progress_goes_to_stderr_so_that_results_can_be_piped(tiny_drive, tmp_path, without_pages):
    result = run("odometry", tiny_drive, "--residual", "none", "-o", tmp_path / "run")
    assert "25/25 scans (100 %)" in result.stderr
    assert "(100 %)" not in result.stdout


def test_the_version_is_the_packages():
    assert ok("--version").split() == ["hybridlio", hybridlio.__version__]


def test_the_vertical_angle_can_be_set(tiny_drive, tmp_path, without_pages):
    said = refused(2, "odometry", tiny_drive, "--vertical-angle", 9)
    assert "vertical_angle_deg: 9.0 is no calibration error" in said
    heights = []
    for name, angle in (("as-is", 0), ("raised", 1)):
        ok("odometry", tiny_drive, "--vertical-angle", angle, "--frames", ":3", "-o", tmp_path / name)
        heights.append(float(Keyframes.load(tmp_path / name / "keyframes.npz").points(0)[:, 2].mean()))
    assert heights[1] > heights[0] + 0.05
