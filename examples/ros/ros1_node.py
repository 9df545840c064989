"""A ROS 1 node: PointCloud2 and Imu in, nav_msgs/Odometry with covariance and a transform out.

python ros1_node.py _calibration:=calibration.yaml points:=/points imu:=/imu/data

Subscribes to ``points`` and ``imu``; publishes ``odometry`` at each scan, ``odometry_predicted`` at each IMU sample and
the transform odom → lidar on ``/tf``. Parameters: ``~calibration``, a file with T_imu_lidar; ``~lag_s``;
``~odom_frame``.
"""

from __future__ import annotations

import os
import sys
from typing import Any

import numpy as np

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
if os.path.isdir("/usr/lib/python3/dist-packages"):  # Debian's rospy, behind this environment's own packages
    sys.path.append("/usr/lib/python3/dist-packages")

import rospy
from bridge import Bridge, fill_odometry, fill_transform
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Imu, PointCloud2
from tf2_msgs.msg import TFMessage


def time_of(stamp_ns: int) -> Any:
    return rospy.Time(*divmod(stamp_ns, 10**9))


def main() -> None:
    rospy.init_node("hybridlio")
    parent = rospy.get_param("~odom_frame", "odom")
    estimated = rospy.Publisher("odometry", Odometry, queue_size=100)
    predicted = rospy.Publisher("odometry_predicted", Odometry, queue_size=100)
    transforms = rospy.Publisher("/tf", TFMessage, queue_size=100)

    def message(stamp_ns: int, T: np.ndarray, covariance: np.ndarray) -> Odometry:
        made = Odometry()
        made.header.stamp = time_of(stamp_ns)
        fill_odometry(made, (parent, bridge.lidar_frame), T, covariance)
        return made

    def publish(stamp_ns: int, T: np.ndarray, covariance: np.ndarray) -> None:
        estimated.publish(message(stamp_ns, T, covariance))
        transform = TransformStamped()
        transform.header.stamp, transform.header.frame_id = time_of(stamp_ns), parent
        transform.child_frame_id = bridge.lidar_frame
        fill_transform(transform.transform, T)
        transforms.publish(TFMessage([transform]))

    def publish_predicted(stamp_ns: int, T: np.ndarray, covariance: np.ndarray) -> None:
        predicted.publish(message(stamp_ns, T, covariance))

    lag_s = float(rospy.get_param("~lag_s", 0.5))
    bridge = Bridge(rospy.get_param("~calibration"), publish, publish_predicted, lag_s)
    large = 2**26  # bytes: rospy drops what does not fit, and a cloud has several megabytes
    rospy.Subscriber("points", PointCloud2, bridge.on_cloud, queue_size=20, buff_size=large)
    rospy.Subscriber("imu", Imu, bridge.on_imu, queue_size=2000, tcp_nodelay=True)
    rospy.on_shutdown(bridge.close)
    rospy.spin()


if __name__ == "__main__":
    main()
