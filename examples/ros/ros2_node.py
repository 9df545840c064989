"""A ROS 2 node: PointCloud2 and Imu in, nav_msgs/Odometry with covariance and a transform out.

python ros2_node.py --ros-args -p calibration:=calibration.yaml -r points:=/points -r imu:=/imu/data

Topics and parameters are those of ros1_node.py. In tests it runs with a stand-in of rclpy and of ROS 2's messages; it
has not been run with ROS 2 itself.
"""

from __future__ import annotations

import contextlib
import os
import sys
from typing import Any

import numpy as np

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))

import rclpy
from bridge import Bridge, fill_odometry, fill_transform
from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Imu, PointCloud2
from tf2_msgs.msg import TFMessage


def time_of(stamp_ns: int) -> Any:
    seconds, nanoseconds = divmod(stamp_ns, 10**9)
    return Time(sec=seconds, nanosec=nanoseconds)


class HybridLioNode(Node):  # type: ignore[misc]  # rclpy has no types here
    """Topics and parameters of the node."""

    def __init__(self) -> None:
        super().__init__("hybridlio")
        self._parent = self.declare_parameter("odom_frame", "odom").value
        lag_s = float(self.declare_parameter("lag_s", 0.5).value)
        calibration = self.declare_parameter("calibration", "calibration.yaml").value
        self._estimated = self.create_publisher(Odometry, "odometry", 100)
        self._predicted = self.create_publisher(Odometry, "odometry_predicted", 100)
        self._transforms = self.create_publisher(TFMessage, "/tf", 100)
        self.bridge = Bridge(calibration, self._publish, self._publish_predicted, lag_s)
        groups = [MutuallyExclusiveCallbackGroup() for _ in range(2)]
        sensors = qos_profile_sensor_data
        self.create_subscription(PointCloud2, "points", self.bridge.on_cloud, sensors, callback_group=groups[0])
        self.create_subscription(Imu, "imu", self.bridge.on_imu, sensors, callback_group=groups[1])

    def _message(self, stamp_ns: int, T: np.ndarray, covariance: np.ndarray) -> Any:
        made = Odometry()
        made.header.stamp = time_of(stamp_ns)
        fill_odometry(made, (self._parent, self.bridge.lidar_frame), T, covariance)
        return made

    def _publish(self, stamp_ns: int, T: np.ndarray, covariance: np.ndarray) -> None:
        self._estimated.publish(self._message(stamp_ns, T, covariance))
        transform = TransformStamped()
        transform.header.stamp, transform.header.frame_id = time_of(stamp_ns), self._parent
        transform.child_frame_id = self.bridge.lidar_frame
        fill_transform(transform.transform, T)
        self._transforms.publish(TFMessage(transforms=[transform]))

    def _publish_predicted(self, stamp_ns: int, T: np.ndarray, covariance: np.ndarray) -> None:
        self._predicted.publish(self._message(stamp_ns, T, covariance))


def main() -> None:
    rclpy.init()
    node = HybridLioNode()
    executor = MultiThreadedExecutor(num_threads=2)
    executor.add_node(node)
    try:
        with contextlib.suppress(KeyboardInterrupt):
            executor.spin()
    finally:
        node.bridge.close()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
