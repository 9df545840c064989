"""What is shown of runs in the Rerun viewer, live and afterwards, read back from files."""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import ok, refused
from rerun_files import RerunFile

from hybridlio.core import se3
from hybridlio.core.errors import DataError
from hybridlio.core.sensors import GpsFix
from hybridlio.datasets.sequence import Sequence
from hybridlio.odometry.odometry import Odometry
from hybridlio.record.record import Record
from hybridlio.runs.folder import METRICS, read_run
from hybridlio.runs.results.states import States
from hybridlio.runs.run import Run, finish_run
from hybridlio.viewing import rerun_layout as names
from hybridlio.viewing.rerun_live import LiveView
from hybridlio.viewing.rerun_stream import rerun_stream
from hybridlio.viewing.scene import SHOWN_POINTS
from hybridlio.viewing.view import view

pytest.importorskip("rerun", reason="the viewer's extra is not installed: pip install 'hybridlio[view]'")
pytestmark = pytest.mark.usefixtures("plain_logging", "without_pages")
EVERY_SCAN = (names.PATH, names.SIGMA_M, names.SIGMA_DEG, names.RESIDUAL_M, names.RESIDUAL_DEG, names.SPEED)


@pytest.fixture(scope="module")
def shown(finished_run: Path, tmp_path_factory: pytest.TempPathFactory) -> RerunFile:
    path = tmp_path_factory.mktemp("view") / "run.rrd"
    assert "25 scans" in ok("view", finished_run, "--save", path)
    return RerunFile(path)


def test_a_finished_run_is_shown_with_poses_path_scans_and_map(shown: RerunFile, finished_run: Path) -> None:
    trajectory = read_run(finished_run).trajectory
    positions = trajectory.poses[:, :3, 3]
    np.testing.assert_allclose(shown.singles(names.LIDAR, "translation"), positions, atol=1e-5)
    steps = shown.singles(names.PATH, "strips")
    np.testing.assert_allclose(steps, np.stack([positions[:-1], positions[1:]], axis=1), atol=1e-5)
    clouds = shown.values(names.POINTS, "positions")
    assert len(clouds) == 25
    assert 0 < max(map(len, clouds)) <= SHOWN_POINTS
    assert len(shown.values(names.MAP, "positions")) >= 4


def test_uncertainty_biases_and_residuals_are_shown_over_time(shown: RerunFile, finished_run: Path) -> None:
    for entity in EVERY_SCAN:
        assert len(shown.scans(entity, "strips" if entity == names.PATH else "scalars")) in (24, 25), entity
    covariances = read_run(finished_run).trajectory.covariances
    sigmas = np.sqrt(covariances[:, 3:, 3:].trace(axis1=1, axis2=2))
    np.testing.assert_allclose(shown.singles(names.SIGMA_M, "scalars"), sigmas)
    states = States.load(finished_run / "states.npz")
    for entity, biases in ((names.ACCEL_BIAS, states.accel_biases_m_s2), (names.GYRO_BIAS, states.gyro_biases_rad_s)):
        np.testing.assert_array_equal(shown.values(entity, "scalars"), biases[1:])
    record = Record.load(finished_run / "odometry.npz")
    steps = zip(record.initial, record.relative, strict=True)
    moved = [np.linalg.norm(se3.log(b.pose @ se3.inverse(a.pose))[3:]) for a, b in steps]
    np.testing.assert_allclose(shown.singles(names.RESIDUAL_M, "scalars")[1:], moved, atol=1e-9)


def test_ellipsoids_have_the_covariances_axes(shown: RerunFile, finished_run: Path) -> None:
    covariances = read_run(finished_run).trajectory.covariances
    for scan, half in zip(
        shown.scans(names.ELLIPSOIDS, "half_sizes"), shown.singles(names.ELLIPSOIDS, "half_sizes"), strict=True
    ):
        sigmas = np.sqrt(np.linalg.eigvalsh(covariances[scan, 3:, 3:]))
        np.testing.assert_allclose(half, np.maximum(3 * sigmas, 1e-3), rtol=1e-5)


def test_bridged_and_doubtful_scans_are_marked(finished_run: Path, tmp_path: Path) -> None:
    run = shutil.copytree(finished_run, tmp_path / "run")
    metrics = json.loads((run / METRICS).read_text()) | {"rejected": [7], "imu_left_out": [9, 10]}
    (run / METRICS).write_text(json.dumps(metrics))
    record = Record.load(run / "odometry.npz")
    free = np.array([[0, 0, 0, 1.0, 0, 0]])
    relative = [*record.relative]
    relative[4], relative[11] = replace(relative[4], ok=False), replace(relative[11], degenerate=free)
    replace(record, relative=tuple(relative)).save(run / "odometry.npz")
    view(run, tmp_path / "run.rrd", scans=False)
    shown = RerunFile(tmp_path / "run.rrd")
    marked = {name: shown.scans(names.doubts(name), "positions") for name in ("bridged", "rejected", "IMU left out")}
    assert marked == {"bridged": [5], "rejected": [7], "IMU left out": [9, 10]}
    states = dict(zip(shown.scans(names.SUPPORT, "state"), shown.values(names.SUPPORT, "state"), strict=True))
    assert {scan: name for scan, (name,) in states.items()} == {
        0: "supported", 5: "bridged", 6: "supported", 7: "rejected", 8: "supported", 9: "IMU left out", 11: "supported",
    }  # fmt: skip
    arrows = dict(zip(shown.scans(names.FREE_SHIFT, "vectors"), shown.values(names.FREE_SHIFT, "vectors"), strict=True))
    assert arrows[12] == [[5.0, 0.0, 0.0]]
    assert arrows[13] == []  # the arrow goes with its scan


def test_fixes_and_loops_of_a_smoothed_run_are_shown_with_residuals(finished_run: Path, tmp_path: Path) -> None:
    run = shutil.copytree(finished_run, tmp_path / "run")
    record = Record.load(run / "odometry.npz")
    fixes = (
        GpsFix(int(stamp), pose[:3, 3] + (50, 60, 7), 0.01 * np.eye(3))
        for stamp, pose in zip(record.online.stamps_ns, record.online.poses @ se3.inverse(T_imu(record)), strict=True)
    )
    replace(record, gps=tuple(fixes)).save(run / "odometry.npz")
    ok("smooth", run, "--gps", "--max-shift", 0)
    metrics = json.loads((run / "smoothed" / METRICS).read_text())
    metrics["loops"] = {"scans": [[2, 20]]}
    (run / "smoothed" / METRICS).write_text(json.dumps(metrics))
    scene = view(run / "smoothed", tmp_path / "run.rrd", scans=False)
    shown = RerunFile(tmp_path / "run.rrd")
    assert len(shown.scans(names.FIXES, "positions")) == 25
    assert np.abs(shown.values(names.FIX_RESIDUAL, "scalars")).max() < 0.1
    at = read_run(run / "smoothed").trajectory.poses[[2, 20], :3, 3]
    np.testing.assert_allclose(shown.singles(names.LOOPS, "strips"), [at], atol=1e-5)
    assert (f"{names.OTHERS}/odometry", "strips") in shown.static
    assert len(shown.scans(names.GYRO_BIAS, "scalars")) == 25  # those of smoothing
    assert scene.left_out == ()


def T_imu(record: Record) -> np.ndarray:
    return record.calibration.T_imu_lidar


def test_without_its_recording_a_run_is_shown_with_its_map_and_says_what_is_missing(
    finished_run: Path, tmp_path: Path
) -> None:
    run = shutil.copytree(finished_run, tmp_path / "run")
    metrics = json.loads((run / METRICS).read_text())
    metrics["recording"]["path"] = str(tmp_path / "gone")
    (run / METRICS).write_text(json.dumps(metrics))
    (run / "states.npz").unlink()  # as of an earlier release
    scene = view(run, tmp_path / "run.rrd")
    assert "biases" in scene.left_out[0]
    assert "gone" in scene.left_out[1]
    shown = RerunFile(tmp_path / "run.rrd")
    assert names.POINTS not in shown.entities
    assert len(shown.values(names.MAP, "positions")) >= 4


def test_a_run_is_shown_while_it_goes_as_afterwards(sequence: Sequence, shown: RerunFile, tmp_path: Path) -> None:
    run = Run(sequence, Odometry())
    with rerun_stream("live", tmp_path / "live.rrd") as stream:
        live = LiveView(stream, run)
        finish_run(run, watcher=live)
        live.finish()
    seen = RerunFile(tmp_path / "live.rrd")
    assert shown.entities - seen.entities == set()
    for entity, component in ((names.LIDAR, "translation"), (names.INITIAL, "translation"), (names.SIGMA_M, "scalars")):
        np.testing.assert_allclose(seen.singles(entity, component), shown.singles(entity, component), atol=1e-5)
    assert seen.scans(names.NIS, "scalars") == shown.scans(names.NIS, "scalars")


def test_the_run_goes_on_without_the_viewer(
    sequence: Sequence, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    run = Run(sequence.part(0, 5), Odometry())
    with rerun_stream("live", tmp_path / "live.rrd") as stream:
        live = LiveView(stream, run)
        monkeypatch.setattr("hybridlio.viewing.rerun_live.thinned", None)
        finish_run(run, watcher=live)
        live.finish()
    assert run.stopped is None
    assert run.done == 5
    assert caplog.text.count("the viewer shows no more scans") == 1


def test_the_odometry_writes_a_file_for_the_viewer(tiny_drive: Path, tmp_path: Path) -> None:
    ok("odometry", tiny_drive, "-n", 12, "--no-check", "-o", tmp_path / "run", "--save", tmp_path / "run.rrd")
    assert RerunFile(tmp_path / "run.rrd").scans(names.LIDAR, "translation") == list(range(12))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run", "run.rrd"]


def test_an_existing_file_stays_without_overwrite(finished_run: Path, tmp_path: Path) -> None:
    (tmp_path / "run.rrd").write_text("mine")
    assert "exists; choose another file" in refused(2, "view", finished_run, "--save", tmp_path / "run.rrd")
    assert (tmp_path / "run.rrd").read_text() == "mine"


def test_a_file_that_a_full_disk_cuts_off_is_no_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hybridlio.viewing.rerun_stream._END", b"not what Rerun writes")
    with (
        pytest.raises(DataError, match="cut off; choose a place with free space"),
        rerun_stream("x", tmp_path / "a.rrd"),
    ):
        pass
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (("--view",), "no display"),
        (("--visualize",), "no display"),
        (("--save", "run.txt"), "run.txt: a recording for the viewer is named *.rrd"),
        (("--save", "none/run.rrd"), "there is no folder none"),
        (("--view", "--save", "run.rrd"), "give one of them"),
    ],
)
def test_where_a_run_cannot_be_shown_is_said_before_it_starts(
    options: tuple[str, ...], named: str, tiny_drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert named in refused(2, "odometry", tiny_drive, *options)
    assert list(tmp_path.iterdir()) == []


def test_without_the_viewers_library_one_line_says_what_to_install(
    finished_run: Path, tiny_drive: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    for words in (("view", finished_run), ("odometry", tiny_drive, "--view")):
        assert "pip install 'hybridlio[view]'" in refused(1, *words)
