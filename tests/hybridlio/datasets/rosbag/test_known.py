"""Bags of published data sets are read without options, with the published extrinsics."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bags
import numpy as np
import pytest

from hybridlio.core.errors import DataError
from hybridlio.core.sensors import Scan
from hybridlio.datasets import open_sequence
from hybridlio.datasets.rosbag.choices import BagTopics
from hybridlio.datasets.rosbag.known import KNOWN, KnownBag


def write_like(path: Path, known: KnownBag, ride: Any) -> Path:
    """Write the topics of a data set, a second IMU among them, without transforms."""
    messages = bags.Messages(is_ros2=False)
    content: list[bags.Message] = []
    for k, t in enumerate(ride.stamps_ns.tolist()):
        scan = Scan(t, ride.points(k)[:, :3].astype(np.float32))
        cloud = messages.cloud(t, bags.structured(scan), "os_lidar")
        content.append((t, known.lidar, "sensor_msgs/msg/PointCloud2", cloud))
        second = messages.imu(t, [0, 0, 9], [0, 0, 9.81], "other")
        content += [(t, f"{other}imu", "sensor_msgs/msg/Imu", second) for other in known.others]
    imu = ride.imu(ride.imu_stamps_ns(10))
    for t, gyro, accel in zip(imu.stamps_ns.tolist(), imu.gyro_rad_s, imu.accel_m_s2, strict=True):
        content.append((t, known.imu, "sensor_msgs/msg/Imu", messages.imu(t, gyro, accel, "os_imu")))
    return bags.write(path, messages, content)


@pytest.mark.parametrize("known", KNOWN, ids=lambda known: known.name)
def test_a_bag_of_a_published_data_set_needs_no_options(known: KnownBag, recordings: Any, tmp_path: Path) -> None:
    sequence = open_sequence(write_like(tmp_path / "ride.bag", known, recordings.ride))
    np.testing.assert_array_equal(sequence.calibration.T_imu_lidar, known.T_imu_lidar)
    assert np.abs(sequence.imu.gyro_rad_s[:, 2] - 0.2).max() < 1e-9
    assert any(f"published for {known.name}" in note for note in sequence.notes)


def test_extrinsics_of_a_data_set_are_not_used_for_other_topics(recordings: Any, tmp_path: Path) -> None:
    known = KNOWN[0]
    bag = write_like(tmp_path / "ride.bag", known, recordings.ride)
    with pytest.raises(DataError, match="no fixed transform"):
        open_sequence(bag, topics=BagTopics(imu=f"{known.others[0]}imu"))


def test_the_odometry_of_a_robots_tracks_is_no_reference(recordings: Any, tmp_path: Path) -> None:
    known = next(known for known in KNOWN if "robot" in known.name)
    ride, messages = recordings.ride, bags.Messages(is_ros2=False)
    content: list[bags.Message] = []
    for k, t in enumerate(ride.stamps_ns.tolist()):
        cloud = messages.cloud(t, bags.structured(Scan(t, ride.points(k)[:, :3].astype(np.float32))), "rslidar")
        content.append((t, known.lidar, "sensor_msgs/msg/PointCloud2", cloud))
        content.append((t, "/track_odometry", "nav_msgs/msg/Odometry", messages.odometry(t, np.eye(4), "base_link")))
        imu = messages.imu(t, [0, 0, 0.2], [0, 0, 9.81], "xsens_imu_link")
        content += [(t, topic, "sensor_msgs/msg/Imu", imu) for topic in (known.imu, "/oak_cam_front/imu")]
    sequence = open_sequence(bags.write(tmp_path / "site2_robot_1.bag", messages, content))
    assert sequence.reference is None
    # the lidar looks ahead and stands on its head beside the IMU
    np.testing.assert_allclose(sequence.calibration.T_imu_lidar[:3, 2], [0, 0, -1], atol=0.04)
