"""The ROS 1 node runs against a real master and ``rosbag play``; conversions fit the messages of both versions."""

from __future__ import annotations

import importlib.util
import json
import os
import runpy
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import bags
import numpy as np
import pytest
from rclpy_stand_in import Graph, message_class, received, ros2
from scipy.spatial.transform import Rotation
from streams import thinned, with_point_times

import hybridlio as hl
from hybridlio.core import se3
from hybridlio.datasets.rosbag.live import LiveClouds, header_ns, imu_sample
from hybridlio.datasets.sequence import Sequence

ROOT = Path(__file__).resolve().parents[1]
PYTHON, MASTER, ROSBAG = Path("/usr/bin/python3"), Path("/usr/bin/rosmaster"), Path("/usr/bin/rosbag")
MS = 1_000_000

LISTENER = """
import json, sys, rospy
from nav_msgs.msg import Odometry
from tf2_msgs.msg import TFMessage
out = open(sys.argv[1], "w", buffering=1)
def row(name, header, child, t, q, covariance):
    values = [t.x, t.y, t.z, q.x, q.y, q.z, q.w]
    out.write(json.dumps([name, header.stamp.to_nsec(), header.frame_id, child, values, list(covariance)]) + "\\n")
def odometry(name):
    def take(m):
        row(name, m.header, m.child_frame_id, m.pose.pose.position, m.pose.pose.orientation, m.pose.covariance)
    return take
def transforms(m):
    for t in m.transforms:
        row("tf", t.header, t.child_frame_id, t.transform.translation, t.transform.rotation, [])
rospy.init_node("listener")
rospy.Subscriber("odometry", Odometry, odometry("odometry"), queue_size=1000)
rospy.Subscriber("odometry_predicted", Odometry, odometry("predicted"), queue_size=5000)
rospy.Subscriber("/tf", TFMessage, transforms, queue_size=1000)
out.write("[]\\n")
rospy.spin()
"""


@pytest.fixture(scope="module")
def bridge() -> ModuleType:
    spec = importlib.util.spec_from_file_location("ros_bridge", ROOT / "examples/ros/bridge.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def recording(tiny_drive: Path) -> Sequence:
    return with_point_times(thinned(hl.open_sequence(tiny_drive), 4))


def calibration_file(folder: Path, recording: Sequence) -> Path:
    path = folder / "calibration.yaml"
    path.write_text("T_imu_lidar: " + json.dumps(recording.calibration.T_imu_lidar.tolist()) + "\n")
    return path


def scans_of(recording: Sequence) -> list[hl.Scan]:
    return [recording.load_scan(k) for k in range(len(recording))]


def offline(recording: Sequence) -> list[hl.Estimate]:
    odometry = hl.Odometry(keep_record=False)
    return [odometry.step(frame) for frame in recording]


# ----------------------------------------------------------------------------------------------- both nodes


@pytest.mark.parametrize("is_ros2", [False, True])
def test_a_bridge_publishes_the_estimates_of_the_recording(bridge, recording, tmp_path, is_ros2):
    """With stand-ins: messages of ``rosbags``, whose attributes have the names of rclpy's."""
    messages, published, predicted = bags.Messages(is_ros2), [], []
    calibration = str(calibration_file(tmp_path, recording))
    node = bridge.Bridge(calibration, lambda *row: published.append(row), lambda *row: predicted.append(row), 30.0)
    content = bags.drive_messages(messages, scans_of(recording), recording.imu, np.eye(4))
    for _, topic, _, message in sorted(content, key=lambda row: row[0]):
        if topic == "/points":
            node.on_cloud(message)
        elif topic == "/imu/data":
            node.on_imu(message)
    node.close()
    expected = offline(Sequence("live", recording.stamps_ns, recording.load_scan, recording.imu, recording.calibration))
    assert [row[0] for row in published] == recording.stamps_ns.tolist()
    np.testing.assert_allclose([row[1] for row in published], [e.pose for e in expected], atol=1e-9)
    assert node.lidar_frame == "lidar"
    assert all(np.isfinite(row[2]).all() for row in predicted)


def test_covariances_have_the_order_and_the_axes_of_ros(bridge, rng):
    T = se3.exp([0.1, -0.4, 2.0, 5, -3, 1])
    noise = rng.normal(size=(100_000, 6)) * [1e-3, 2e-3, 3e-3, 0.01, 0.02, 0.03]
    moved = T @ se3.exp(noise)
    positions = moved[:, :3, 3] - T[:3, 3]
    turns = Rotation.from_matrix(moved[:, :3, :3] @ T[:3, :3].T).as_rotvec()
    sampled = np.cov(np.hstack([positions, turns]).T)
    found = np.reshape(bridge.ros_covariance(T, np.cov(noise.T)), (6, 6))
    np.testing.assert_allclose(found, sampled, rtol=0.02, atol=1e-7)


def test_messages_are_filled_as_ros_defines_them(bridge):
    messages = bags.Messages(True)
    T, covariance = se3.exp([0.1, 0.2, 0.3, 1, 2, 3]), np.diag([1e-6, 2e-6, 3e-6, 1e-4, 2e-4, 3e-4])
    made = messages.odometry(10**9, np.eye(4), "")
    object.__setattr__(made.pose, "covariance", None)
    bridge.fill_odometry(made, ("odom", "lidar"), T, covariance)
    assert (made.header.frame_id, made.child_frame_id) == ("odom", "lidar")
    q, p = made.pose.pose.orientation, made.pose.pose.position
    np.testing.assert_allclose(Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), T[:3, :3])
    np.testing.assert_allclose([p.x, p.y, p.z], T[:3, 3])
    assert len(made.pose.covariance) == len(made.twist.covariance) == 36
    transform = messages.transform(0, "odom", "lidar", np.eye(4))
    bridge.fill_transform(transform.transform, T)
    assert transform.transform.translation.x == T[0, 3]


def test_live_clouds_need_three_messages_to_know_their_columns(recording):
    messages, clouds = bags.Messages(True), LiveClouds()
    scans = scans_of(recording)[:5]
    counts = [len(clouds.add(messages.cloud(scan.stamp_ns, bags.structured(scan)))) for scan in scans]
    assert counts == [0, 0, 3, 1, 1]
    with pytest.raises(hl.HybridLioError, match="a message has no stamp"):
        header_ns(messages.header(0, "lidar"))
    stamp_ns, gyro, accel = imu_sample(messages.imu(5 * 10**9, [1, 2, 3], [4, 5, 6]))
    assert (stamp_ns, gyro, accel) == (5 * 10**9, (1, 2, 3), (4, 5, 6))


# ---------------------------------------------------------------------------------------------------- ROS 2


def two_estimates_are_published(graph: Graph) -> None:
    wait_for(lambda: len(graph.messages("odometry")) > 1, "estimates of the first half")


def test_the_ros2_node_publishes_the_estimates_of_the_recording(recording, tmp_path, monkeypatch):
    """With a stand-in of rclpy, as ROS 2 cannot be installed from Debian or PyPI."""
    maker = bags.Messages(True)
    content = bags.drive_messages(maker, scans_of(recording), recording.imu, np.eye(4))
    names = {"/points": "points", "/imu/data": "imu"}
    waiting = [
        (names[topic], received(message, kind))
        for _, topic, kind, message in sorted(content, key=lambda row: row[0])
        if topic in names
    ]
    parameters = {"calibration": str(calibration_file(tmp_path, recording)), "lag_s": 30.0}
    half = len(waiting) // 2
    graph = Graph(parameters, [waiting[:half], waiting[half:]], between=two_estimates_are_published)
    monkeypatch.setattr(sys, "path", list(sys.path))
    with ros2(graph):
        runpy.run_path(str(ROOT / "examples/ros/ros2_node.py"), run_name="__main__")
    assert not graph.is_up
    expected = offline(Sequence("live", recording.stamps_ns, recording.load_scan, recording.imu, recording.calibration))
    for message, tf, estimate in zip(graph.messages("odometry"), graph.messages("/tf"), expected, strict=True):
        assert header_ns(message.header) == header_ns(tf.transforms[0].header) == estimate.stamp_ns
        assert (message.header.frame_id, message.child_frame_id) == ("odom", "lidar")
        position, moved = message.pose.pose.position, tf.transforms[0].transform.translation
        np.testing.assert_allclose([position.x, position.y, position.z], estimate.pose[:3, 3], atol=1e-9)
        assert (moved.x, moved.y, moved.z) == (position.x, position.y, position.z)
        assert message.pose.covariance[0] > 0
    predicted = [header_ns(message.header) for message in graph.messages("odometry_predicted")]
    assert predicted == sorted(predicted)
    assert len(predicted) > 0


def test_the_stand_in_of_ros2_refuses_what_ros2_refuses():
    odometry = message_class("nav_msgs/msg/Odometry")()
    for where, name, value in (
        (odometry.header.stamp, "nanosec", -1),
        (odometry.pose.pose.position, "x", 1),
        (odometry, "child_frame_id", None),
        (odometry.pose, "covariance", [0.0] * 35),
        (odometry, "header", "odom"),
    ):
        with pytest.raises(AssertionError, match=name):
            setattr(where, name, value)


# ---------------------------------------------------------------------------------------------------- ROS 1


def ros_is_here() -> bool:
    needed = "import rospy, rosgraph, nav_msgs.msg, sensor_msgs.msg, tf2_msgs.msg"
    return (
        all(path.exists() for path in (PYTHON, MASTER, ROSBAG))
        and not subprocess.run([PYTHON, "-c", needed], capture_output=True, check=False).returncode
    )


@contextmanager
def running(command: list[Any], env: dict[str, str], log: Path) -> Iterator[subprocess.Popen[bytes]]:
    with log.open("wb") as file:
        process = subprocess.Popen([*map(str, command)], env=env, stdout=file, stderr=subprocess.STDOUT)
        try:
            yield process
        finally:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(timeout=20)
            except subprocess.TimeoutExpired:
                process.kill()


def wait_for(condition: Any, what: str, seconds: float = 60) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, what
        time.sleep(0.1)


def test_the_ros_1_node_publishes_what_the_bag_gives_offline(recording, tmp_path):
    if not ros_is_here():
        pytest.skip("ROS 1 is not installed (on Debian: python3-{rospy,rosbag,rosmaster,nav-msgs,tf2-msgs})")
    messages, scans = bags.Messages(False), scans_of(recording)
    content = bags.drive_messages(messages, scans, recording.imu, recording.calibration.T_imu_lidar)
    bag = bags.write(tmp_path / "drive.bag", messages, [row for row in content if row[1] != "/tf_static"])
    calibration = calibration_file(tmp_path, recording)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    env = {**os.environ, "ROS_MASTER_URI": f"http://127.0.0.1:{port}", "ROS_IP": "127.0.0.1"}
    env |= {"ROS_LOG_DIR": str(tmp_path), "ROS_HOME": str(tmp_path), "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    plain = {key: value for key, value in env.items() if key != "PYTHONPATH"}
    heard, node_log = tmp_path / "heard.jsonl", tmp_path / "node.log"

    def rows(name: str) -> list[Any]:
        return [row for row in map(json.loads, heard.read_text().splitlines()) if row and row[0] == name]

    node = [sys.executable, ROOT / "examples/ros/ros1_node.py", f"_calibration:={calibration}", "_lag_s:=20"]
    with (
        running([MASTER, "--core", "-p", port], plain, tmp_path / "master.log"),
        running([PYTHON, "-c", LISTENER, heard], plain, tmp_path / "listener.log"),
        running([*node, "points:=/points", "imu:=/imu/data"], env, node_log),
    ):
        wait_for(lambda: heard.exists() and heard.read_text(), "no listener")
        play = [ROSBAG, "play", "--delay=3", "--rate=0.5", "--wait-for-subscribers", bag]
        played = subprocess.run(play, env=plain, capture_output=True, check=False, timeout=120)
        assert played.returncode == 0, played.stderr.decode()
        wait_for(lambda: len(rows("tf")) >= len(scans), node_log.read_text()[-2000:], 60)
    expected = {e.stamp_ns: e for e in offline(hl.open_sequence(bag))}
    found = rows("odometry")
    assert [row[1] for row in found] == recording.stamps_ns.tolist()
    for _, stamp_ns, parent, child, values, covariance in found:
        assert (parent, child) == ("odom", "lidar")
        T = se3.make(Rotation.from_quat(values[3:]).as_matrix(), values[:3])
        np.testing.assert_allclose(T, expected[stamp_ns].pose, atol=1e-6)
        assert np.diag(np.reshape(covariance, (6, 6)))[:3].sum() == pytest.approx(
            expected[stamp_ns].covariance[3:, 3:].trace(), rel=1e-6
        )
    assert [row[1] for row in rows("tf")] == [row[1] for row in found]
    assert len(rows("predicted")) > 100
