"""MCAP files for Foxglove, read back by the ``mcap`` package, which shares no code with what writes them."""

from __future__ import annotations

import json
import shutil
import sys
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import ok, refused
from scipy.spatial.transform import Rotation

from hybridlio.core import se3
from hybridlio.core.geodesy import GeodeticPoint
from hybridlio.core.sensors import NS_PER_S, GpsFix
from hybridlio.record.record import Record
from hybridlio.runs.folder import METRICS, read_run
from hybridlio.runs.results.states import States
from hybridlio.viewing.mcap_export import export_mcap
from hybridlio.viewing.scene import SHOWN_POINTS

pytest.importorskip("foxglove", reason="Foxglove's SDK is not installed: pip install 'hybridlio[foxglove]'")
pytest.importorskip("mcap_protobuf", reason="mcap-protobuf-support is not installed")
pytestmark = pytest.mark.usefixtures("plain_logging", "without_pages")


def read(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """Return the stamps and messages of each topic."""
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory

    topics = defaultdict(list)
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        assert {index.compression for index in reader.get_summary().chunk_indexes} == {"zstd"}
        for _, channel, message in reader.iter_messages(log_time_order=True):
            if channel.message_encoding == "json":
                topics[channel.topic].append((message.log_time, json.loads(message.data)))
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        named = [c.topic for c in reader.get_summary().channels.values() if c.message_encoding == "protobuf"]
        for _, channel, message, decoded in reader.iter_decoded_messages(topics=named):
            topics[channel.topic].append((message.log_time, decoded))
    return topics


def pose(position: Any, turned: Any) -> np.ndarray:
    R = Rotation.from_quat([turned.x, turned.y, turned.z, turned.w]).as_matrix()
    return se3.make(R, [position.x, position.y, position.z])


def points(cloud: Any) -> np.ndarray:
    assert [field.name for field in cloud.fields] == ["x", "y", "z"]
    return np.frombuffer(cloud.data, "<f4").reshape(-1, 3)


@pytest.fixture(scope="module")
def written(finished_run: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[tuple[int, Any]]]:
    path = tmp_path_factory.mktemp("mcap") / "run.mcap"
    assert "25 scans" in ok("export", finished_run, "--mcap", path, "--scans")
    assert [file.name for file in path.parent.iterdir()] == ["run.mcap"]
    return read(path)


def test_poses_stamps_and_covariances_come_back(written: Any, finished_run: Path) -> None:
    trajectory = read_run(finished_run).trajectory
    assert [stamp for stamp, _ in written["/tf"]] == trajectory.stamps_ns.tolist()
    assert {(one.parent_frame_id, one.child_frame_id) for _, one in written["/tf"]} == {("map", "lidar")}
    moved = np.array([pose(one.translation, one.rotation) for _, one in written["/tf"]])
    np.testing.assert_allclose(moved, trajectory.poses, atol=1e-12)
    stamped = [one.timestamp.seconds * NS_PER_S + one.timestamp.nanos for _, one in written["/odometry"]]
    assert stamped == trajectory.stamps_ns.tolist()
    poses = np.array([pose(one.pose.position, one.pose.orientation) for _, one in written["/odometry"]])
    np.testing.assert_allclose(poses, trajectory.poses, atol=1e-12)
    ((_, path),) = written["/path"]
    np.testing.assert_allclose([pose(p.position, p.orientation) for p in path.poses], trajectory.poses, atol=1e-12)
    for k, (_, one) in enumerate(written["/odometry"]):
        given = np.array(one.pose_covariance).reshape(6, 6)
        R, ours = trajectory.poses[k, :3, :3], trajectory.covariances[k]
        np.testing.assert_allclose(given[:3, :3], R @ ours[3:, 3:] @ R.T, rtol=1e-9, atol=1e-18)
        np.testing.assert_allclose(given[3:, 3:], R @ ours[:3, :3] @ R.T, rtol=1e-9, atol=1e-18)
        np.testing.assert_allclose(given[:3, 3:], R @ ours[3:, :3] @ R.T, rtol=1e-9, atol=1e-18)


def test_clouds_and_diagnostics_come_back(written: Any, finished_run: Path) -> None:
    assert len(written["/scan"]) == 25
    assert {one.frame_id for _, one in written["/scan"]} == {"lidar"}
    assert 0 < max(len(points(one)) for _, one in written["/scan"]) <= SHOWN_POINTS
    ((_, whole),) = written["/map"]
    assert whole.frame_id == "map"
    assert len(points(whole)) > 1000
    states = States.load(finished_run / "states.npz")
    given = [one["gyro_bias_rad_s"] for _, one in written["/diagnostics"][1:]]  # the first scan has none
    np.testing.assert_allclose([[v["x"], v["y"], v["z"]] for v in given], states.gyro_biases_rad_s[1:])
    assert {one["support"] for _, one in written["/diagnostics"]} == {"supported"}
    assert len(written["/initial_pose"]) == 24
    assert written["/covariance"]


def test_without_the_option_no_scans_are_written(finished_run: Path, tmp_path: Path) -> None:
    export_mcap(finished_run, tmp_path / "run.mcap")
    topics = read(tmp_path / "run.mcap")
    assert "/scan" not in topics
    assert "/map" in topics


def test_fixes_loops_and_doubtful_scans_of_a_smoothed_run_come_back(finished_run: Path, tmp_path: Path) -> None:
    run = shutil.copytree(finished_run, tmp_path / "run")
    record = Record.load(run / "odometry.npz")
    origin = GeodeticPoint(48.0, 11.0, 500.0)
    at = (record.online.poses @ se3.inverse(record.calibration.T_imu_lidar))[:, :3, 3]
    fixes = (
        GpsFix(int(stamp), place, 0.01 * np.eye(3), origin)
        for stamp, place in zip(record.online.stamps_ns, at, strict=True)
    )
    replace(record, gps=tuple(fixes)).save(run / "odometry.npz")
    ok("smooth", run, "--gps", "--max-shift", 0)
    metrics = json.loads((run / METRICS).read_text()) | {"rejected": [7]}
    (run / METRICS).write_text(json.dumps(metrics))
    smoothed = json.loads((run / "smoothed" / METRICS).read_text()) | {"loops": {"scans": [[2, 20]]}}
    (run / "smoothed" / METRICS).write_text(json.dumps(smoothed))
    scene = export_mcap(run / "smoothed", tmp_path / "run.mcap")
    assert scene.left_out == ()
    topics = read(tmp_path / "run.mcap")
    assert len(topics["/gps/fix"]) == len(topics["/gps/residuals"]) == 25
    assert topics["/gps/fix"][0][1].latitude == pytest.approx(48.0, abs=1e-4)
    assert [stamp for stamp, _ in topics["/loops"]] == [scene.scans[20].stamp_ns]
    assert [stamp for stamp, _ in topics["/doubtful"]] == [scene.scans[7].stamp_ns]
    assert "rejected" in topics["/log"][-1][1].message
    assert "/path/odometry" in topics
    assert topics["/tf"][0][1].parent_frame_id == "enu"


@pytest.mark.parametrize(
    ("code", "run", "file", "named"),
    [
        (2, "RUN", "run.bag", "run.bag: the file is named *.mcap"),
        (2, "RUN", "none/run.mcap", "there is no folder none"),
        (2, "nowhere", "run.mcap", "nowhere: no such folder"),
    ],
)
def test_unusable_input_is_one_line_and_writes_nothing(
    code: int, run: str, file: str, named: str, finished_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert named in refused(code, "export", finished_run if run == "RUN" else run, "--mcap", file)
    assert list(tmp_path.iterdir()) == []


def test_without_foxgloves_library_one_line_says_what_to_install(
    finished_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)
    line = refused(1, "export", finished_run, "--mcap", tmp_path / "run.mcap")
    assert "pip install 'hybridlio[foxglove]'" in line


def test_a_full_disk_and_an_existing_file_are_one_line(
    finished_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise RuntimeError("FoxgloveError: MCAP error: I/O error")

    with monkeypatch.context() as patch:
        patch.setattr("hybridlio.viewing.mcap_export._write_fixes", full)
        assert "choose a place with free space" in refused(2, "export", finished_run, "--mcap", tmp_path / "a.mcap")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "a.mcap").write_text("mine")
    assert "exists; choose another file" in refused(2, "export", finished_run, "--mcap", tmp_path / "a.mcap")
