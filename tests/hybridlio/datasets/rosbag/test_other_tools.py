"""Bags that tools other than ``rosbags`` write: ``mcap-ros2-support``, and ROS 1's own ``rosbag``."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hybridlio.datasets import Sequence, open_sequence

HEADER = "std_msgs/Header header\n"
PARTS = {
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
    "geometry_msgs/Transform": "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n",
    "geometry_msgs/TransformStamped": HEADER + "string child_frame_id\ngeometry_msgs/Transform transform\n",
    "sensor_msgs/PointField": "string name\nuint32 offset\nuint8 datatype\nuint32 count\n",
}
TYPES = {
    "sensor_msgs/msg/Imu": HEADER
    + "geometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\n"
    + "geometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\n"
    + "geometry_msgs/Vector3 linear_acceleration\nfloat64[9] linear_acceleration_covariance\n",
    "sensor_msgs/msg/PointCloud2": HEADER
    + "uint32 height\nuint32 width\nsensor_msgs/PointField[] fields\nbool is_bigendian\nuint32 point_step\n"
    + "uint32 row_step\nuint8[] data\nbool is_dense\n",
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms\n",
}
COUNT = 5
ROS_1_WRITER = """
import sys, struct
import rosbag, rospy
from sensor_msgs.msg import Imu, PointCloud2, PointField
from geometry_msgs.msg import TransformStamped
from tf2_msgs.msg import TFMessage

def at(message, ns, frame):
    message.header.stamp = rospy.Time(ns // 10**9, ns % 10**9)
    message.header.frame_id = frame
    return message

with rosbag.Bag(sys.argv[1], "w", compression=sys.argv[2]) as bag:
    mount = at(TransformStamped(), 0, "imu")
    mount.child_frame_id, mount.transform.translation.x, mount.transform.rotation.w = "lidar", 0.5, 1.0
    start = 1_700_000_000 * 10**9
    bag.write("/tf_static", TFMessage([mount]), rospy.Time(1_700_000_000))
    for k in range(60):
        imu = at(Imu(), start + k * 10**7, "imu")
        imu.angular_velocity.z, imu.linear_acceleration.z = 0.01 * k, 9.81
        bag.write("/imu", imu, imu.header.stamp)
    for k in range(5):
        cloud = at(PointCloud2(), start + k * 10**8, "lidar")
        cloud.height, cloud.width, cloud.point_step, cloud.row_step = 1, 40, 16, 640
        cloud.fields = [PointField(n, 4 * i, 7 if i < 3 else 6, 1) for i, n in enumerate(["x", "y", "z", "t"])]
        cloud.data = b"".join(struct.pack("<fffI", 3 + i + k, 2 * i, 1, i * 2_000_000) for i in range(40))
        bag.write("/points", cloud, cloud.header.stamp)
"""


def check(sequence: Sequence) -> None:
    """Check that a sequence is the one that the writers here write."""
    assert len(sequence) == COUNT
    assert sequence.stamps_ns.tolist() == [1_700_000_000 * 10**9 + k * 10**8 for k in range(COUNT)]
    np.testing.assert_allclose(sequence.calibration.T_imu_lidar[:3, 3], [0.5, 0, 0])
    np.testing.assert_allclose(sequence.imu.gyro_rad_s[:, 2], 0.01 * np.arange(60))
    np.testing.assert_allclose(sequence.imu.accel_m_s2[:, 2], 9.81)
    scan = sequence[2].scan
    np.testing.assert_array_equal(scan.points[:, 0], 5 + np.arange(40))
    assert scan.time_offsets_ns is not None
    assert scan.time_offsets_ns.tolist() == [i * 2_000_000 for i in range(40)]


def definition(name: str) -> str:
    """Return a type's definition followed by those of the types in it, as bags hold it."""
    rule = "\n" + "=" * 80 + "\n"
    return TYPES[name] + "".join(f"{rule}MSG: {part}\n{text}" for part, text in PARTS.items())


def header(ns: int, frame: str) -> dict[str, Any]:
    return {"stamp": {"sec": ns // 10**9, "nanosec": ns % 10**9}, "frame_id": frame}


@pytest.mark.parametrize("compression", ["NONE", "LZ4", "ZSTD"])
@pytest.mark.parametrize("is_chunked", [True, False])
def test_files_of_mcap_ros2_support_are_read(tmp_path: Path, compression: str, is_chunked: bool) -> None:
    pytest.importorskip("mcap_ros2", reason="mcap-ros2-support is not installed")
    from mcap.writer import CompressionType
    from mcap_ros2.writer import Writer

    path, start = tmp_path / "other.mcap", 1_700_000_000 * 10**9
    zero, one = {"x": 0.0, "y": 0.0, "z": 0.0}, {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
    rows: list[tuple[int, str, str, dict[str, Any]]] = []
    move = {"translation": zero | {"x": 0.5}, "rotation": one}
    mount = {"header": header(0, "imu"), "child_frame_id": "lidar", "transform": move}
    rows.append((start, "/tf_static", "tf2_msgs/msg/TFMessage", {"transforms": [mount]}))
    for k in range(60):
        t = start + k * 10**7
        imu = {"header": header(t, "imu"), "orientation": one, "angular_velocity": zero | {"z": 0.01 * k}}
        imu |= {"linear_acceleration": zero | {"z": 9.81}}
        imu |= {f"{what}_covariance": [0.0] * 9 for what in ("orientation", "angular_velocity", "linear_acceleration")}
        rows.append((t, "/imu", "sensor_msgs/msg/Imu", imu))
    for k in range(COUNT):
        t = start + k * 10**8
        points = np.zeros(40, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("t", "<u4")])
        points["x"], points["y"], points["z"] = 3 + k + np.arange(40), 2 * np.arange(40), 1
        points["t"] = np.arange(40) * 2_000_000
        fields = [
            {"name": name, "offset": 4 * i, "datatype": 7 if i < 3 else 6, "count": 1} for i, name in enumerate("xyzt")
        ]
        cloud = {"header": header(t, "lidar"), "height": 1, "width": 40, "fields": fields, "is_bigendian": False}
        cloud |= {"point_step": 16, "row_step": 640, "data": points.tobytes(), "is_dense": True}
        rows.append((t, "/points", "sensor_msgs/msg/PointCloud2", cloud))
    rows.sort(key=lambda row: row[0])
    with path.open("wb") as file, Writer(file, compression=CompressionType[compression], enable_crcs=True) as writer:
        if not is_chunked:
            writer._writer._Writer__chunk_builder = None  # type: ignore[attr-defined]
        schemas = {name: writer.register_msgdef(name, definition(name)) for name in TYPES}
        for t, topic, name, message in rows:
            writer.write_message(topic, schemas[name], message, log_time=t, publish_time=t)
    check(open_sequence(path))


@pytest.mark.parametrize("compression", ["none", "bz2", "lz4"])
def test_bags_of_ros_1_are_read(tmp_path: Path, compression: str) -> None:
    python, needed = "/usr/bin/python3", "import rosbag, sensor_msgs.msg, tf2_msgs.msg, geometry_msgs.msg"
    if not Path(python).exists() or subprocess.run([python, "-c", needed], capture_output=True, check=False).returncode:
        pytest.skip("ROS 1 is not installed (on Debian: python3-rosbag python3-sensor-msgs python3-tf2-msgs)")
    path = tmp_path / "other.bag"
    subprocess.run([python, "-c", ROS_1_WRITER, str(path), compression], check=True, capture_output=True)
    check(open_sequence(path))
