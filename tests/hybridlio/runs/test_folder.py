import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import trapezoid
from scipy.spatial.transform import Rotation

from hybridlio.core import se3
from hybridlio.core.errors import DataError, EstimationError
from hybridlio.core.sensors import Calibration
from hybridlio.core.trajectory import read_kitti, read_tum
from hybridlio.datasets.registry import open_sequence
from hybridlio.odometry.config import Config, load_config
from hybridlio.odometry.odometry import Odometry
from hybridlio.record.record import Record
from hybridlio.runs import folder as run_folder
from hybridlio.runs.results.report_input import report_data
from hybridlio.runs.run import Run, run_odometry
from hybridlio.runs.write import write_run

CONFIG = Config(residual="none")
T_CAMERA_LIDAR = se3.exp([1.2, -1.2, 1.2, 0.1, -0.2, 0.3])


def run_of(drive: Path, **changes: object) -> Run:
    sequence = replace(open_sequence(drive).part(0, 12), **changes)
    return run_odometry(sequence, Odometry(config=CONFIG))


@pytest.fixture(scope="module")
def run(tiny_drive) -> Run:
    return run_of(tiny_drive)


@pytest.fixture(scope="module")
def folder(run, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("run")
    write_run(path, run, CONFIG)
    return path


def test_a_run_folder_has_exactly_the_documented_files(folder):
    assert sorted(path.name for path in folder.iterdir()) == sorted(run_folder.FILES)


def test_pose_files_have_one_row_per_scan_with_at_least_nine_decimals(folder, run):
    for name, columns in (("poses_tum.txt", 8), ("poses_kitti.txt", 12)):
        rows = [line.split() for line in (folder / name).read_text().splitlines() if not line.startswith("#")]
        assert len(rows) == len(run.sequence)
        assert {len(row) for row in rows} == {columns}
        assert min(len(number.partition(".")[2]) for row in rows for number in row) >= 9


def test_pose_files_contain_the_estimate(folder, run):
    tum = read_tum(folder / "poses_tum.txt")
    assert tum.stamps_ns.tolist() == run.trajectory.stamps_ns.tolist()
    np.testing.assert_allclose(tum.poses, run.trajectory.poses, atol=1e-9)
    np.testing.assert_allclose(read_kitti(folder / "poses_kitti.txt").poses, run.trajectory.poses, atol=1e-9)


def test_covariances_npz_has_covariances_of_poses_and_steps(folder, run):
    with np.load(folder / "covariances.npz") as file:
        assert file["stamps_ns"].tolist() == run.sequence.stamps_ns.tolist()
        np.testing.assert_array_equal(file["absolute"], run.trajectory.covariances)
        np.testing.assert_array_equal(file["relative"], run.steps.covariances)
        np.testing.assert_array_equal(file["relative_poses"], run.steps.poses)
        assert file["estimated"].all()


def test_record_and_configuration_can_be_loaded(folder, run):
    record = Record.load(folder / "odometry.npz")
    np.testing.assert_allclose(record.online.poses, run.trajectory.poses, atol=1e-12)
    assert load_config(folder / "config.yaml") == CONFIG


def test_metrics_json_has_settings_counts_lengths_and_errors(folder, run):
    output = json.loads((folder / "metrics.json").read_text())
    assert (output["frames_done"], output["frames"], output["interrupted"]) == (12, 12, False)
    assert (output["initial_pose"], output["residual"], output["backend"]) == (
        CONFIG.initial_pose, CONFIG.residual, CONFIG.backend,
    )  # fmt: skip
    path, true = run.trajectory.poses[:, :3, 3], run.sequence.reference.poses[:, :3, 3]
    assert output["path_length_m"] == pytest.approx(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
    driven = trapezoid(run.sequence.forward_speed_m_s, run.sequence.stamps_ns / 1e9)
    assert output["forward_speed_length_m"] == pytest.approx(driven)
    assert output["forward_speed_length_m"] == pytest.approx(run.sequence.reference.length_m, rel=0.02)
    _, left = Rotation.align_vectors(true - true.mean(0), path - path.mean(0))
    assert output["ate_m"] == pytest.approx(left / np.sqrt(len(path)), rel=1e-6)
    assert output["ms_per_scan"]["total"] > output["ms_per_scan"]["graph"] > 0


def test_a_run_is_read_as_written(folder, run):
    stored = run_folder.read_run(folder)
    np.testing.assert_allclose(stored.trajectory.poses, run.trajectory.poses, atol=1e-9)
    np.testing.assert_array_equal(stored.trajectory.covariances, run.trajectory.covariances)
    np.testing.assert_array_equal(stored.steps.poses, run.steps.poses)
    np.testing.assert_allclose(stored.reference.poses, run.sequence.reference.poses, atol=1e-9)
    assert len(stored.stamps_before) == 0
    assert stored.T_camera_lidar is None


def test_a_run_without_reference_or_forward_speed_is_written_without_them(tiny_drive, without_pages, tmp_path):
    run = run_of(tiny_drive, reference=None, forward_speed_m_s=None)
    write_run(tmp_path, run, CONFIG)
    assert not (tmp_path / "reference_tum.txt").exists()
    stored = run_folder.read_run(tmp_path)
    assert stored.reference is None
    assert stored.metrics["forward_speed_length_m"] is None
    assert "ate_m" not in stored.metrics


def test_kitti_pose_files_of_odometry_sequences_are_in_the_camera_frame(tiny_drive, without_pages, run, tmp_path):
    calibration = Calibration(run.sequence.calibration.T_imu_lidar, T_CAMERA_LIDAR)
    seen = run_of(tiny_drive, calibration=calibration, pose_file_frame="camera")
    write_run(tmp_path, seen, CONFIG)
    camera = T_CAMERA_LIDAR @ seen.trajectory.poses @ se3.inverse(T_CAMERA_LIDAR)
    np.testing.assert_allclose(read_kitti(tmp_path / "poses_kitti.txt").poses, camera, atol=1e-9)
    np.testing.assert_allclose(read_tum(tmp_path / "poses_tum.txt").poses, seen.trajectory.poses, atol=1e-9)
    np.testing.assert_allclose(run_folder.read_run(tmp_path).T_camera_lidar, T_CAMERA_LIDAR)


def test_scans_before_the_first_usable_one_have_rows_with_the_covariance_of_an_unknown_motion(
    tiny_drive, without_pages, tmp_path
):
    sequence = open_sequence(tiny_drive).part(0, 12)

    def load(k):
        if k < 3:
            raise DataError(f"{k}.bin: truncated")
        return sequence.load_scan(k)

    run = run_odometry(replace(sequence, load_scan=load), Odometry(config=CONFIG))
    assert report_data(run, run.record, CONFIG, "", [], None).first_scan == 3
    write_run(tmp_path, run, CONFIG)
    whole = read_tum(tmp_path / "poses_tum.txt")
    assert whole.stamps_ns.tolist() == sequence.stamps_ns.tolist()
    np.testing.assert_allclose(whole.poses[:3], np.tile(np.eye(4), (3, 1, 1)), atol=1e-9)
    with np.load(tmp_path / "covariances.npz") as file:
        assert file["estimated"].tolist() == [False] * 3 + [True] * 9
        sigmas_m = np.sqrt(file["absolute"][:, 3, 3])
    assert (sigmas_m[:3] > 1).all()
    assert (np.diff(sigmas_m[:4]) < 0).all()  # the earlier, the more uncertain
    stored = run_folder.read_run(tmp_path)
    assert stored.trajectory.stamps_ns.tolist() == sequence.stamps_ns[3:].tolist()
    assert len(stored.steps.poses) == 8
    assert stored.metrics["skipped"] == 3
    vertices = re.findall(r"^VERTEX_SE3:QUAT (\d+)", (tmp_path / "graph.g2o").read_text(), re.MULTILINE)
    assert list(map(int, vertices)) == list(range(3, 12))


def test_a_run_of_one_estimate_is_written_without_record_and_graph(tiny_drive, tmp_path):
    run = run_odometry(open_sequence(tiny_drive).part(0, 1), Odometry(config=CONFIG))
    write_run(tmp_path, run, CONFIG)
    assert len(read_tum(tmp_path / "poses_tum.txt")) == 1
    assert not (tmp_path / "odometry.npz").exists()
    assert (tmp_path / "report.html").exists()


def test_writing_a_run_without_estimates_is_an_error_and_keeps_an_older_run(folder, tiny_drive):
    run = Run(open_sequence(tiny_drive), Odometry())
    with pytest.raises(EstimationError, match="no estimate to write"):
        write_run(folder, run, CONFIG)
    assert run_folder.is_run_folder(folder)


@pytest.mark.parametrize(
    ("name", "text"), [("metrics.json", "{"), ("covariances.npz", "no zip"), ("poses_tum.txt", "1 2")]
)
def test_reading_a_malformed_run_names_the_folder(name, text, folder, tmp_path):
    damaged = shutil.copytree(folder, tmp_path / "run")
    (damaged / name).write_text(text)
    with pytest.raises(DataError, match=str(damaged)):
        run_folder.read_run(damaged)


def test_reading_a_folder_without_a_run_is_an_error(tmp_path):
    with pytest.raises(DataError, match="not a run folder"):
        run_folder.read_run(tmp_path)
    with pytest.raises(DataError, match="no such folder"):
        run_folder.read_run(tmp_path / "none")


def _halved(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _flipped(path: Path) -> None:
    content = bytearray(path.read_bytes())
    third = len(content) // 3
    content[third : third + 60] = bytes(byte ^ 0xFF for byte in content[third : third + 60])
    path.write_bytes(content)


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        ("covariances.npz", _halved),
        ("covariances.npz", _flipped),
        ("metrics.json", _halved),
        ("metrics.json", lambda path: path.write_text("[]")),
        ("metrics.json", lambda path: path.write_text('{"sequence": "town"}')),
        ("poses_tum.txt", lambda path: path.write_text("".join(path.read_text().splitlines(True)[:5]))),
    ],
)
def test_reading_a_damaged_file_names_folder_and_files(folder, tmp_path, name, damage):
    damaged = shutil.copytree(folder, tmp_path / "run")
    damage(damaged / name)
    with pytest.raises(DataError, match=rf"{damaged}: metrics.json, poses_tum.txt or covariances.npz cannot"):
        run_folder.read_run(damaged)
