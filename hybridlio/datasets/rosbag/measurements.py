"""What a bag's messages measured: stamps of scans, inertial samples, GPS fixes and reference poses."""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hybridlio.core.arrays import Array, Mask, Stamps
from hybridlio.core.errors import DataError
from hybridlio.core.geodesy import GeodeticPoint, check_geodetic, enu_from_geodetic
from hybridlio.core.sensors import NS_PER_S, GpsFix, ImuSamples
from hybridlio.core.tables import counted
from hybridlio.datasets.gps_csv import assumed_where_unknown, usable_covariance
from hybridlio.datasets.imu_csv import clean_imu, in_si_units
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.rosbag.transforms import pose_of
from hybridlio.datasets.rosbag.wire import Header
from hybridlio.datasets.stamps import sorted_unique

_MAX_DELAY_S = 1.0  # between a stamp and its receipt; drivers and networks take milliseconds, other clocks are far off
_MAX_DELAY_DIFFERENCE_S = 0.2  # between lidar and IMU; a sweep is stamped 0.1 s before it is sent
_IMU_PARTS = {"angular velocity": slice(0, 3), "linear acceleration": slice(3, 6)}  # of the values of a message
_LATEST_NS = 2**63 - 1  # of a stamp as an int64


@dataclass
class Log:
    """Stamps and values of one topic's messages, in order of receipt, packed so that hours of them fit into memory.

    Attributes:
        frame: the frame of the first message.
        header_ns, received_ns: one entry per message.
        values: what is kept of the messages, the same count of numbers for each.
    """

    frame: str = ""
    header_ns: array[int] = field(default_factory=lambda: array("q"))
    received_ns: array[int] = field(default_factory=lambda: array("q"))
    values: array[float] = field(default_factory=lambda: array("d"))

    def add(self, header: Header, received_ns: int) -> None:
        """Add a message's stamps.

        Raises:
            DataError: the time of receipt is no time of this age, as in a damaged file.
        """
        if received_ns > _LATEST_NS:
            raise DataError(f"a message was received at {received_ns} ns, after the year 2262: the bag is damaged")
        if not self.header_ns:
            self.frame = header.frame
        self.header_ns.append(header.stamp_ns)
        self.received_ns.append(received_ns)

    def __len__(self) -> int:
        return len(self.header_ns)

    def rows(self) -> Array:
        """Return the values, a row per message."""
        return np.array(self.values).reshape(len(self), -1) if len(self) else np.empty((0, 0))

    def delay_s(self) -> float:
        """Return the median time from stamp to receipt."""
        return float(np.median(np.array(self.received_ns) - np.array(self.header_ns))) / NS_PER_S if len(self) else 0.0


def stamps_of(log: Log, topic: str, notes: Notes) -> tuple[Stamps, Mask]:
    """Return the stamps of a topic's messages, and which messages have one.

    They are the headers' stamps, or the times of receipt if all of those are zero. Zeros among other stamps, and stamps
    far from the times of receipt, are noted.
    """
    header, received = np.array(log.header_ns, dtype=np.int64), np.array(log.received_ns, dtype=np.int64)
    known = header != 0
    if not known.any():
        notes.add(f"{topic}: the headers' stamps are zero; times of receipt are used, which vary by milliseconds")
        return received, np.ones(len(received), dtype=bool)
    if not known.all():
        notes.corrected(f"{topic}: dropped {counted(int((~known).sum()), 'message')} without a stamp")
    delay_s = float(np.median(received[known] - header[known])) / NS_PER_S
    if abs(delay_s) > _MAX_DELAY_S:
        notes.add(f"{topic}: stamps are {delay_s:.3f} s before the times of receipt; stamps are used")
    return header, known


def note_clocks(lidar: Log, imu: Log, notes: Notes) -> None:
    """Note if stamps of lidar and IMU are at different distances from their times of receipt."""
    if not (any(lidar.header_ns) and any(imu.header_ns)):
        return
    difference_s = lidar.delay_s() - imu.delay_s()
    if abs(difference_s) > _MAX_DELAY_DIFFERENCE_S:
        notes.add(
            f"scans are received {lidar.delay_s():.3f} s after their stamps, inertial samples {imu.delay_s():.3f} s; "
            "the clocks of lidar and IMU may differ"
        )


@np.errstate(over="ignore")  # damaged files hold any bits
def imu_samples(log: Log, topic: str, notes: Notes) -> ImuSamples:
    """Return the samples of a log of angular velocity and specific force, sorted; corrections are noted.

    Raises:
        DataError: no sample is finite, or the messages hold no rates or no forces.
    """
    stamps, known = stamps_of(log, topic, notes)
    values = log.rows()
    absent = [what for what, part in _IMU_PARTS.items() if np.isnan(values[:, part]).all()]
    if absent:
        raise DataError(
            f"{topic}: its messages say that they hold no {' and no '.join(absent)} (zeros, with a covariance of -1); "
            "choose another IMU by --imu-topic, or none by '--imu-topic none'"
        )
    return clean_imu(topic, stamps[known], in_si_units(topic, values[known], notes), notes)


def fix_values(message: Any) -> tuple[float, ...]:
    """Return latitude, longitude (degrees), height (m) and the nine covariances (m²) of a ``sensor_msgs/NavSatFix``.

    The position is NaN if the receiver has no fix.
    """
    has_fix = message.status.status >= 0
    position = (message.latitude, message.longitude, message.altitude) if has_fix else (np.nan,) * 3
    covariance = message.position_covariance if message.position_covariance_type else (np.nan,) * 9
    return (*position, *(float(value) for value in covariance))


def gps_fixes(log: Log, topic: str, notes: Notes) -> tuple[GpsFix, ...]:
    """Return the fixes of a log of :func:`fix_values`, sorted, in the east-north-up frame of the first.

    Raises:
        DataError: a latitude or longitude is impossible.
    """
    stamps, known = stamps_of(log, topic, notes)
    rows = log.rows()
    fixed = known & np.isfinite(rows[:, :3]).all(axis=1) & rows[:, :2].any(axis=1)  # some receivers write zeros
    if not fixed.all():
        notes.add(f"{topic}: {int((~fixed).sum())} of {len(log)} messages have no fix")
    if not fixed.any():
        return ()
    stamps, rows = stamps[fixed], rows[fixed]
    order = sorted_unique(stamps, topic, notes)
    stamps, rows = stamps[order], rows[order]
    for row in rows:
        check_geodetic(row[0], row[1], row[2], f"{notes.name}: {topic}")
    origin = GeodeticPoint(*rows[0, :3].tolist())
    covariances = assumed_where_unknown([usable_covariance(row[3:].reshape(3, 3)) for row in rows], topic, notes)
    return tuple(
        GpsFix(int(t), position, covariance, origin)
        for t, position, covariance in zip(stamps, enu_from_geodetic(rows[:, :3], origin), covariances, strict=True)
    )


def body_pose(message: Any, type_name: str) -> tuple[str, tuple[float, ...]]:
    """Return the child frame (empty if the type has none) and the twelve numbers of a pose message, row by row.

    Raises:
        DataError: the pose is not finite, or its quaternion is zero.
    """
    child = getattr(message, "child_frame_id", "").lstrip("/")
    if type_name.endswith("TransformStamped"):
        T = pose_of(message.transform.translation, message.transform.rotation, "a reference pose")
    else:
        pose = message.pose if type_name.endswith("/PoseStamped") else message.pose.pose
        T = pose_of(pose.position, pose.orientation, "a reference pose")
    return child, tuple(T[:3].ravel().tolist())


def poses_of(log: Log, topic: str, notes: Notes) -> tuple[Stamps, Array]:
    """Return stamps and ``(R, 4, 4)`` poses of a log of :func:`body_pose`, sorted."""
    stamps, known = stamps_of(log, topic, notes)
    poses = np.tile(np.eye(4), (int(known.sum()), 1, 1))
    poses[:, :3] = log.rows()[known].reshape(-1, 3, 4)
    stamps = stamps[known]
    order = sorted_unique(stamps, topic, notes)
    return stamps[order], poses[order]


def no_messages(topic: str) -> DataError:
    """Return the error of a topic whose messages are missing though the index counts them."""
    return DataError(f"{topic}: the index counts messages, but there are none; the bag is damaged")
