"""What the nodes of ROS 1 and ROS 2 share: messages into an OdometryStream, and estimates into messages."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import hybridlio as hl
from hybridlio.datasets.calibration_yaml import read_calibration_yaml
from hybridlio.datasets.rosbag.live import LiveClouds, imu_sample

_log = logging.getLogger("hybridlio")

Publish = Callable[[int, np.ndarray, np.ndarray], None]  # stamp in ns, pose (4, 4), covariance (6, 6)


class Bridge:
    """Feeds messages to a stream, and calls ``publish`` with each estimate.

    Args:
        calibration: path of a ``calibration.yaml`` with ``T_imu_lidar``.
        publish: takes stamp, pose ``T_odom_lidar`` and covariance of each estimate, in the stream's thread.
        publish_predicted: the same for a prediction at every IMU sample; None for no predictions.
        lag_s: how long scans wait for IMU samples.
    """

    def __init__(
        self, calibration: str, publish: Publish, publish_predicted: Publish | None = None, lag_s: float = 0.5
    ) -> None:
        stated = read_calibration_yaml(Path(calibration), needs_imu=True)
        self._clouds, self._publish_predicted = LiveClouds(stated.format), publish_predicted
        self._imu_offset_ns = round((stated.imu_time_offset_s or 0.0) * 1e9)
        self._lock = threading.Lock()  # callbacks may come from several threads
        self.lidar_frame = "lidar"
        self.stream = hl.OdometryStream(
            stated.calibration,
            on_estimate=lambda e: publish(e.stamp_ns, e.pose, e.covariance),
            imu_noise=stated.imu_noise,
            lag_s=lag_s,
        )

    def on_cloud(self, message: Any) -> None:
        """Take a ``sensor_msgs/PointCloud2``."""
        try:
            with self._lock:
                scans = self._clouds.add(message)
                self.lidar_frame = message.header.frame_id or self.lidar_frame
            for scan in scans:
                self.stream.add_scan(scan.stamp_ns, scan.points, scan.time_offsets_ns)
        except hl.HybridLioError as error:
            _log.error("a cloud is not used: %s", error)

    def on_imu(self, message: Any) -> None:
        """Take a ``sensor_msgs/Imu``."""
        try:
            stamp_ns, gyro_rad_s, accel_m_s2 = imu_sample(message)
            stamp_ns += self._imu_offset_ns
            self.stream.add_imu(stamp_ns, gyro_rad_s, accel_m_s2)
            if self._publish_predicted is not None and self.stream.counts.estimates > 1:
                predicted = self.stream.predict(stamp_ns)
                self._publish_predicted(stamp_ns, predicted.pose, predicted.covariance)
        except hl.HybridLioError as error:
            _log.error("an IMU sample is not used: %s", error)

    def close(self) -> None:
        """Estimate what still waits, and log the counts."""
        self.stream.close()
        _log.info("%s", self.stream.counts)


def fill_pose(pose: Any, T: np.ndarray) -> None:
    """Write a pose ``(4, 4)`` into a ``geometry_msgs/Pose``."""
    pose.position.x, pose.position.y, pose.position.z = T[:3, 3].tolist()
    quaternion = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
    pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w = quaternion


def fill_transform(transform: Any, T: np.ndarray) -> None:
    """Write a pose ``(4, 4)`` into a ``geometry_msgs/Transform``."""
    transform.translation.x, transform.translation.y, transform.translation.z = T[:3, 3].tolist()
    quaternion = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
    rotation = transform.rotation
    rotation.x, rotation.y, rotation.z, rotation.w = quaternion


def ros_covariance(T: np.ndarray, covariance: np.ndarray) -> list[float]:
    """Return the 36 numbers of a ``PoseWithCovariance``.

    ROS has position first, and both parts about the fixed axes of the parent frame; ours has rotation first, in the
    frame of the pose.
    """
    J = np.zeros((6, 6))
    J[:3, 3:] = J[3:, :3] = T[:3, :3]
    return np.asarray(J @ covariance @ J.T).ravel().tolist()


def fill_odometry(message: Any, frames: tuple[str, str], T: np.ndarray, covariance: np.ndarray) -> None:
    """Write frames (parent, child), pose and covariance into a ``nav_msgs/Odometry``; its twist is unknown."""
    message.header.frame_id, message.child_frame_id = frames
    fill_pose(message.pose.pose, T)
    message.pose.covariance = ros_covariance(T, covariance)
    unknown = np.zeros(36)
    unknown[0] = -1.0  # as sensor_msgs/Imu marks what is not estimated
    message.twist.covariance = unknown.tolist()
