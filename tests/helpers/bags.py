"""Write a recording as a bag, by the library ``rosbags``."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hybridlio.core.arrays import Array
from hybridlio.core.sensors import ImuSamples, Scan
from hybridlio.core.trajectory import Trajectory

TF_1 = "geometry_msgs/TransformStamped[] transforms\n"
POINT = "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line\n"
CLOUD = (
    "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\n{}CustomPoint[] points\n"
)
DRIVERS = ("livox_ros_driver", "livox_ros_driver2")
KINDS = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}

Message = tuple[int, str, str, Any]  # time of receipt, topic, type, message


def typestore(is_ros2: bool) -> Any:
    """Return the types of ROS with those that ``rosbags`` lacks."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE if is_ros2 else Stores.ROS1_NOETIC)
    if not is_ros2:
        store.register(get_types_from_msg(TF_1, "tf2_msgs/msg/TFMessage"))
    for driver in DRIVERS:
        store.register(get_types_from_msg(POINT, f"{driver}/msg/CustomPoint"))
        store.register(get_types_from_msg(CLOUD.format(f"{driver}/"), f"{driver}/msg/CustomMsg"))
    return store


@dataclass
class Messages:
    """Builds messages of one ROS version."""

    is_ros2: bool
    store: Any = field(init=False)

    def __post_init__(self) -> None:
        self.store = typestore(self.is_ros2)

    def make(self, type_name: str, /, **values: Any) -> Any:
        return self.store.types[type_name](**values)

    def header(self, stamp_ns: int, frame: str) -> Any:
        seconds, nanoseconds = divmod(int(stamp_ns), 10**9)
        stamp = self.make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
        extra = {} if self.is_ros2 else {"seq": 0}
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame, **extra)

    def vector(self, xyz: Iterable[float], name: str = "geometry_msgs/msg/Vector3") -> Any:
        x, y, z = (float(value) for value in xyz)
        return self.make(name, x=x, y=y, z=z)

    def quaternion(self, R: Array) -> Any:
        x, y, z, w = Rotation.from_matrix(R).as_quat().tolist()
        return self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def imu(self, stamp_ns: int, gyro: Array, accel: Array, frame: str = "imu") -> Any:
        return self.make(
            "sensor_msgs/msg/Imu",
            header=self.header(stamp_ns, frame),
            orientation=self.quaternion(np.eye(3)),
            orientation_covariance=np.zeros(9),
            angular_velocity=self.vector(gyro),
            angular_velocity_covariance=np.zeros(9),
            linear_acceleration=self.vector(accel),
            linear_acceleration_covariance=np.zeros(9),
        )

    def cloud(self, stamp_ns: int, points: Any, frame: str = "lidar", **changes: Any) -> Any:
        """A ``PointCloud2`` from a structured array ``(N,)`` or, organised, ``(H, W)``."""
        rows = np.atleast_2d(points)
        fields = [
            self.make(
                "sensor_msgs/msg/PointField",
                name=name, offset=offset, datatype=KINDS[kind.str[1:]], count=1,
            )
            for name, (kind, offset) in ((n, f[:2]) for n, f in (points.dtype.fields or {}).items())
        ]  # fmt: skip
        values = {
            "header": self.header(stamp_ns, frame), "height": rows.shape[0], "width": rows.shape[1], "fields": fields,
            "is_bigendian": False, "point_step": rows.dtype.itemsize, "row_step": rows.dtype.itemsize * rows.shape[1],
            "data": np.frombuffer(rows.tobytes(), np.uint8), "is_dense": True,
        }  # fmt: skip
        return self.make("sensor_msgs/msg/PointCloud2", **values | changes)

    def livox(self, driver: str, scan: Scan, frame: str = "lidar") -> Any:
        offsets = scan.time_offsets_ns
        assert offsets is not None
        start = int(offsets.min())
        intensity = np.zeros(len(scan)) if scan.intensity is None else scan.intensity
        columns = ((offsets - start).tolist(), scan.points.tolist(), np.round(intensity * 255).astype(int).tolist())
        points = [
            self.make(f"{driver}/msg/CustomPoint", offset_time=t, x=x, y=y, z=z, reflectivity=i, tag=16, line=0)
            for t, (x, y, z), i in zip(*columns, strict=True)
        ]
        return self.make(
            f"{driver}/msg/CustomMsg",
            header=self.header(scan.stamp_ns, frame), timebase=scan.stamp_ns + start, point_num=len(points),
            lidar_id=0, rsvd=np.zeros(3, np.uint8), points=points,
        )  # fmt: skip

    def transform(self, stamp_ns: int, parent: str, child: str, T: Array) -> Any:
        move = self.make(
            "geometry_msgs/msg/Transform", translation=self.vector(T[:3, 3]), rotation=self.quaternion(T[:3, :3])
        )
        return self.make(
            "geometry_msgs/msg/TransformStamped",
            header=self.header(stamp_ns, parent), child_frame_id=child, transform=move,
        )  # fmt: skip

    def tf(self, *transforms: Any) -> Any:
        return self.make("tf2_msgs/msg/TFMessage", transforms=list(transforms))

    def pose(self, T: Array) -> Any:
        position = self.vector(T[:3, 3], "geometry_msgs/msg/Point")
        return self.make("geometry_msgs/msg/Pose", position=position, orientation=self.quaternion(T[:3, :3]))

    def odometry(self, stamp_ns: int, T: Array, child: str, frame: str = "map") -> Any:
        zero = self.make("geometry_msgs/msg/Twist", linear=self.vector((0, 0, 0)), angular=self.vector((0, 0, 0)))
        return self.make(
            "nav_msgs/msg/Odometry",
            header=self.header(stamp_ns, frame), child_frame_id=child,
            pose=self.make("geometry_msgs/msg/PoseWithCovariance", pose=self.pose(T), covariance=np.zeros(36)),
            twist=self.make("geometry_msgs/msg/TwistWithCovariance", twist=zero, covariance=np.zeros(36)),
        )  # fmt: skip

    def fix(self, stamp_ns: int, position: Iterable[float], covariance: Any, kind: int = 2, status: int = 0) -> Any:
        latitude, longitude, altitude = (float(value) for value in position)
        return self.make(
            "sensor_msgs/msg/NavSatFix",
            header=self.header(stamp_ns, "gps"),
            status=self.make("sensor_msgs/msg/NavSatStatus", status=status, service=1),
            latitude=latitude, longitude=longitude, altitude=altitude,
            position_covariance=np.asarray(covariance, dtype=np.float64).ravel(), position_covariance_type=kind,
        )  # fmt: skip


def write(path: Path, messages: Messages, content: Iterable[Message], storage: str = "", compress: str = "") -> Path:
    """Write messages in order of receipt.

    Args:
        path: a ``.bag`` file, or a folder of ROS 2.
        messages: the maker of the content, which knows the types.
        content: the messages.
        storage: ``sqlite3`` or ``mcap`` for ROS 2.
        compress: ``bz2`` or ``lz4`` for ROS 1; ``file``, ``message`` or ``storage`` for ROS 2.
    """
    writer = _writer_1(path, compress) if path.suffix == ".bag" else _writer_2(path, storage, compress)
    store, connections = messages.store, {}
    serialise: Callable[..., Any] = store.serialize_cdr if messages.is_ros2 else store.serialize_ros1
    with writer:
        for received_ns, topic, name, message in sorted(content, key=lambda row: row[0]):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=store)
            writer.write(connections[topic], received_ns, serialise(message, name))
    return path


def _writer_1(path: Path, compress: str) -> Any:
    from rosbags.rosbag1 import Writer

    writer = Writer(path)
    if compress:
        writer.set_compression(Writer.CompressionFormat[compress.upper()])
    return writer


def _writer_2(path: Path, storage: str, compress: str) -> Any:
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    writer = Writer(path, version=9, storage_plugin=StoragePlugin[storage.upper()])
    if compress:
        writer.set_compression(CompressionMode[compress.upper()], CompressionFormat.ZSTD)
    return writer


def structured(scan: Scan, time: str = "t") -> Any:
    """Return a scan as a structured array ``x y z intensity``, and times in ns after the stamp."""
    kinds = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")]
    kinds += [(time, "<i4")] if scan.time_offsets_ns is not None else []
    rows = np.zeros(len(scan), kinds)
    for i, axis in enumerate("xyz"):
        rows[axis] = scan.points[:, i]
    rows["intensity"] = 0 if scan.intensity is None else scan.intensity
    if scan.time_offsets_ns is not None:
        rows[time] = scan.time_offsets_ns
    return rows


def drive_messages(
    messages: Messages,
    scans: Iterable[Scan],
    imu: ImuSamples,
    T_imu_lidar: Array,
    reference: Trajectory | None = None,
    livox: str = "",
    delay_ns: int = 2_000_000,
) -> list[Message]:
    """Return a drive's messages: clouds, IMU, the mount in ``/tf_static`` by way of ``base_link``, and odometry."""
    T_base_imu = np.eye(4)
    T_base_imu[:3, 3] = 0.2, -0.1, 0.5
    content: list[Message] = []
    for scan in scans:
        name = f"{livox}/msg/CustomMsg" if livox else "sensor_msgs/msg/PointCloud2"
        made = messages.livox(livox, scan) if livox else messages.cloud(scan.stamp_ns, structured(scan))
        content.append((scan.stamp_ns + delay_ns, "/points", name, made))
    for t, gyro, accel in zip(imu.stamps_ns.tolist(), imu.gyro_rad_s, imu.accel_m_s2, strict=True):
        content.append((t + delay_ns, "/imu/data", "sensor_msgs/msg/Imu", messages.imu(t, gyro, accel)))
    start = min(row[0] for row in content)
    transforms = messages.tf(
        messages.transform(0, "base_link", "imu", T_base_imu),
        messages.transform(0, "base_link", "lidar", T_base_imu @ T_imu_lidar),
    )
    content.append((start, "/tf_static", "tf2_msgs/msg/TFMessage", transforms))
    if reference is not None:
        for t, T in zip(reference.stamps_ns.tolist(), reference.poses, strict=True):
            message = messages.odometry(t, T, "lidar")
            content.append((t + delay_ns, "/truth", "nav_msgs/msg/Odometry", message))
    return content
