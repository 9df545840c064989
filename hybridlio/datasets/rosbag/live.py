"""Messages that arrive one by one, as objects of rospy, rclpy or ``rosbags``: scans, inertial samples, stamps."""

from __future__ import annotations

from typing import Any

import numpy as np

from hybridlio.core.errors import DataError
from hybridlio.core.sensors import NS_PER_S, Scan
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.points.point_format import PointFormat, StatedFormat, find_format
from hybridlio.datasets.rosbag.clouds import Columns, cloud_columns
from hybridlio.datasets.rosbag.wire import measured

# Looked at to find how columns are read: a recording has five of the whole run; here scans wait for it, 0.2 s at 10 Hz.
_SAMPLES = 3


def header_ns(header: Any) -> int:
    """Return the stamp of a ``std_msgs/Header`` of ROS 1 or ROS 2 in nanoseconds.

    Raises:
        DataError: it is zero: the driver sets none.
    """
    stamp = header.stamp
    is_ros1 = hasattr(stamp, "secs")
    seconds, nanoseconds = (stamp.secs, stamp.nsecs) if is_ros1 else (stamp.sec, stamp.nanosec)
    if not (seconds or nanoseconds):
        raise DataError("a message has no stamp; make the driver set header.stamp")
    return int(seconds) * NS_PER_S + int(nanoseconds)


def imu_sample(message: Any) -> tuple[int, tuple[float, ...], tuple[float, ...]]:
    """Return stamp (ns), angular velocity (rad/s) and specific force (m/s²) of a ``sensor_msgs/Imu``.

    Raises:
        DataError: it has no stamp, or says that it holds no rates or no forces.
    """
    rate, force = (
        measured((vector.x, vector.y, vector.z), covariance[0])
        for vector, covariance in (
            (message.angular_velocity, message.angular_velocity_covariance),
            (message.linear_acceleration, message.linear_acceleration_covariance),
        )
    )
    if any(np.isnan((*rate, *force))):
        raise DataError("an inertial message says that it holds no rates or no forces (a covariance of -1)")
    return header_ns(message.header), rate, force


class LiveClouds:
    """Turns clouds into scans, by the same rules as the reader of bags.

    How the points' columns are read (unit, times, codes of beams without a return) is found from the first three clouds
    and noted in the log; these scans therefore come together with the third.

    Args:
        stated: what the user states about points, from ``calibration.yaml``.
    """

    def __init__(self, stated: StatedFormat | None = None) -> None:
        self._stated = stated
        self._format: PointFormat | None = None
        self._first: list[tuple[int, Columns]] = []

    def add(self, message: Any) -> list[Scan]:
        """Take a ``sensor_msgs/PointCloud2``; return the scans that are then known, none or one as a rule.

        Raises:
            DataError: the cloud is malformed or has no stamp, or the meaning of its columns is not clear.
        """
        return self.add_columns(header_ns(message.header), cloud_columns(message))

    def add_columns(self, stamp_ns: int, columns: Columns) -> list[Scan]:
        """As :meth:`add`, for a stamp and columns ``(N,)`` by name, such as those of a Livox message."""
        if self._format is not None:
            return [self._format.scan(columns, stamp_ns)]
        self._first.append((stamp_ns, {name: np.array(values) for name, values in columns.items()}))
        if len(self._first) < _SAMPLES:
            return []
        first, self._first = self._first, []
        step_ns = int(np.median(np.diff([stamp for stamp, _ in first])))
        self._format = find_format(first, step_ns, Notes("live clouds"), self._stated)
        return [self._format.scan(columns, stamp) for stamp, columns in first]
