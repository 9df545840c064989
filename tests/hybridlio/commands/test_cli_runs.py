"""Commands on recordings and run folders."""

import errno
import json
import re
import shutil
from pathlib import Path

import pytest
from command_line import ok, refused, run

from hybridlio.core.trajectory import read_tum
from hybridlio.record.loop_keyframes import LoopKeyframes
from hybridlio.runs.folder import FILES

pytestmark = pytest.mark.usefixtures("plain_logging")


def test_the_learned_front_end_runs_without_a_graph_and_can_be_smoothed(tiny_drive, untrained_weights, tmp_path):
    config, folder = tmp_path / "learned.yaml", tmp_path / "run"
    learned = f"{{weights: {untrained_weights}, device: cpu}}"
    config.write_text(f"initial_pose: lstm\nresidual: network\nbackend: none\nlstm: {learned}\nnetwork: {learned}\n")
    ok("odometry", tiny_drive, "--config", config, "--frames", ":8", "-o", folder)
    assert sorted(path.name for path in folder.iterdir()) == sorted(FILES)
    assert json.loads((folder / "metrics.json").read_text())["backend"] == "none"
    assert "smoothed" in ok("smooth", folder)


def test_the_reference_of_the_run_of_a_file_or_of_a_recording_gives_equal_metrics(finished_run, tiny_drive):
    figures = json.loads(ok("evaluate", finished_run, "--json"))
    assert {"t_rel_percent", "r_rel_deg_per_100m", "ate_m", "rpe_m", "step_anees_rotation"} <= set(figures)
    assert figures["ate_m"] < 0.1
    assert figures["poses"] == 25
    for reference in (tiny_drive, tiny_drive / "poses.txt", finished_run / "reference_tum.txt"):
        again = json.loads(ok("evaluate", finished_run, "--reference", reference, "--json"))
        assert again["ate_m"] == pytest.approx(figures["ate_m"], abs=1e-9)
        assert again["anees_position"] == pytest.approx(figures["anees_position"], rel=1e-6)
    for estimate in ("poses_tum.txt", "poses_kitti.txt"):
        again = json.loads(ok("evaluate", finished_run / estimate, "--reference", tiny_drive, "--json"))
        assert again["ate_m"] == pytest.approx(figures["ate_m"], abs=1e-9)
        assert again["anees_position"] is None


def test_drift_over_given_lengths_is_reported(finished_run):
    figures = json.loads(ok("evaluate", finished_run, "--lengths", "5,10", "--json"))
    assert figures["chosen_lengths_m"] == [5, 10]
    for wrong in ("5,x", "0", ""):
        assert "--lengths" in refused(2, "evaluate", finished_run, "--lengths", wrong)


def test_a_trajectory_file_needs_a_reference(finished_run):
    assert "--reference" in refused(2, "evaluate", finished_run / "poses_tum.txt")


def test_a_run_is_overwritten_only_with_the_option(finished_run, tiny_drive, tmp_path, without_pages):
    folder = shutil.copytree(finished_run, tmp_path / "run")
    before = (folder / "metrics.json").read_bytes()
    assert "--overwrite" in refused(2, "odometry", tiny_drive, "-o", folder)
    assert (folder / "metrics.json").read_bytes() == before
    ok("odometry", tiny_drive, "-o", folder, "--overwrite", "--residual", "none", "--frames", "0:5")
    assert json.loads((folder / "metrics.json").read_text())["frames"] == 5


def test_a_smoothed_run_replaces_another_run_only_with_overwrite(finished_run, tmp_path, without_pages):
    other = shutil.copytree(finished_run, tmp_path / "other")
    assert "--overwrite" in refused(2, "smooth", finished_run, "-o", other)
    assert "the run itself" in refused(2, "smooth", finished_run, "-o", finished_run)
    assert (other / "odometry.npz").exists()
    ok("smooth", finished_run, "-o", other, "--overwrite")
    assert not (other / "odometry.npz").exists()


def test_a_recording_without_imu_uses_constant_velocity_unless_preintegration_is_requested(
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
    """Return the drive with scan 7 truncated and scan 12 empty."""
    date = shutil.copytree(tiny_drive.parent, tmp_path / tiny_drive.parent.name)
    scans = date / tiny_drive.name / "velodyne_points/data"
    with (scans / "0000000007.bin").open("r+b") as file:
        file.truncate(1001)
    (scans / "0000000012.bin").write_bytes(b"")
    return date


def test_unreadable_scans_are_bridged_reported_and_have_rows(damaged, tmp_path):
    result = run("odometry", damaged, "-o", tmp_path / "run")
    assert result.exit_code == 0, result.output
    for name in ("0000000007.bin", "0000000012.bin"):
        assert name in result.stderr
    assert "2 scans bridged by the initial pose: 7, 12" in result.stdout
    metrics = json.loads((tmp_path / "run/metrics.json").read_text())
    assert metrics["bridged"] == [7, 12]
    assert set(metrics["unreadable"]) == {"7", "12"}
    assert metrics["ate_m"] < 0.2
    assert "0000000007.bin" in (tmp_path / "run/report.html").read_text()
    assert len(read_tum(tmp_path / "run/poses_tum.txt")) == 25


def test_a_run_that_starts_late_can_be_compared_with_a_file_of_all_scans(damaged, tmp_path, without_pages):
    scans = damaged / next(path.name for path in damaged.glob("*_sync")) / "velodyne_points/data"
    for k in (0, 1):
        (scans / f"{k:010d}.bin").write_bytes(b"")
    ok("odometry", damaged, "-o", tmp_path / "run")
    assert json.loads((tmp_path / "run/metrics.json").read_text())["skipped"] == 2
    itself = json.loads(ok("evaluate", tmp_path / "run", "--reference", tmp_path / "run/poses_kitti.txt", "--json"))
    assert itself["ate_m"] < 1e-6


def test_an_error_during_the_run_keeps_the_estimates(tiny_drive, tmp_path, monkeypatch, without_pages):
    from hybridlio.core.errors import GraphError
    from hybridlio.graph.run.isam_backend import IncrementalBackend

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


def test_a_file_system_without_links_keeps_the_run_and_logs_a_warning(tiny_drive, tmp_path, monkeypatch, without_pages):
    def fail(*_, **__):
        raise OSError(errno.EPERM, "Operation not permitted")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Path, "symlink_to", fail)
    result = run("odometry", tiny_drive, "--residual", "none", "--frames", ":3")
    assert result.exit_code == 0, result.output
    assert "cannot link runs/latest" in result.stderr
    assert len(list((tmp_path / "runs").glob("*/metrics.json"))) == 1


def test_the_vertical_angle_can_be_set(tiny_drive, tmp_path, without_pages):
    output = refused(2, "odometry", tiny_drive, "--vertical-angle", 9)
    assert "vertical_angle_deg: must be within ±5°, got 9.0" in output
    heights = []
    for name, angle in (("as-is", 0), ("raised", 1)):
        ok("odometry", tiny_drive, "--vertical-angle", angle, "--frames", ":3", "-o", tmp_path / name)
        heights.append(float(LoopKeyframes.load(tmp_path / name / "keyframes.npz").points(0)[:, 2].mean()))
    assert heights[1] > heights[0] + 0.05


def test_scans_without_stamps_run_at_a_given_rate(tiny_drive, tmp_path, without_pages):
    shutil.copytree(tiny_drive / "velodyne_points/data", tmp_path / "bare")
    command = ("odometry", tmp_path / "bare", "--residual", "none", "--frames", ":3")
    assert "give --rate 10" in refused(2, *command)
    ok(*command, "--rate", 20, "-o", tmp_path / "run")
    assert read_tum(tmp_path / "run/poses_tum.txt").stamps_ns.tolist() == [0, 50_000_000, 100_000_000]


def test_a_reason_shared_by_combinations_is_printed_once(tiny_drive, monkeypatch):
    from hybridlio.core.errors import GraphError
    from hybridlio.graph.run.isam_backend import IncrementalBackend

    def fail(self, frame, relative):
        raise GraphError("no")

    monkeypatch.setattr(IncrementalBackend, "update", fail)
    output = refused(1, "compare", tiny_drive, "--initial-pose", "kalman,identity", "--residual", "none",
                   "--backend", "incremental", "--frames", ":3")  # fmt: skip
    assert "kalman + none, identity + none ended after" in output
    assert output.count("error: ") == 1


def test_bridged_scans_are_logged_with_the_reason(tiny_drive, tmp_path, without_pages):
    few = tmp_path / "few.yaml"
    few.write_text("{initial_pose: identity, scan_matching: {min_matched: 0.999}}")
    output = run("odometry", tiny_drive, "--config", few, "--frames", ":12", "-v", "-o", tmp_path / "run").stderr
    assert re.search(r"frame 11: bridged by the initial pose: \d+% of \d+ points match", output)  # the start is over


def test_unusable_scans_at_the_start_cause_at_most_three_warnings(tiny_drive, tmp_path):
    many = tmp_path / "many.yaml"
    many.write_text("scan_matching: {min_points: 10000000}")
    output = run("odometry", tiny_drive, "--config", many, "-o", tmp_path / "run").stderr
    assert output.count("cannot start at this scan") == 3
    assert "no usable scan" in output


def test_the_imu_path_length_agrees_with_the_forward_speed(finished_run):
    figures = json.loads((finished_run / "metrics.json").read_text())
    assert figures["imu_path_length_m"] == pytest.approx(figures["forward_speed_length_m"], rel=0.01)
