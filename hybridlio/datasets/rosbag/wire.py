"""The serialised form of messages, as far as it is read without ``rosbags``, for speed: headers, IMU, Livox's clouds.

``rosbags`` builds a Python object per point of a Livox cloud, several per inertial sample, and deserialises a whole
cloud where only the stamp is needed.

ROS 1 packs fields without gaps, little-endian. ROS 2 uses CDR: four bytes tell the byte order, and then a field of n
bytes starts at a multiple of n (OMG specification of DDS-XTypes 1.3, section 7.4.1).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridlio.core.errors import DataError
from hybridlio.core.sensors import NS_PER_S

_LIVOX_FIELDS = ("offset_time", "x", "y", "z", "reflectivity", "tag", "line")
_LIVOX_KINDS = ("u4", "f4", "f4", "f4", "u1", "u1", "u1")
_LIVOX_BYTES = 19  # of a point without padding


@dataclass(frozen=True)
class Header:
    """The header that starts a message.

    Attributes:
        stamp_ns: its time stamp.
        frame: its frame, without a leading slash.
        end: the position of the byte after it.
        order: ``<`` or ``>``, the message's byte order.
    """

    stamp_ns: int
    frame: str
    end: int
    order: str


def read_header(raw: bytes, is_ros2: bool) -> Header:
    """Read the header of a serialised message.

    Raises:
        DataError: the message is too short.
    """
    try:
        if not is_ros2:
            _, seconds, nanoseconds, size = struct.unpack_from("<IIII", raw, 0)
            order, start = "<", 16
        else:
            order, start = "<" if raw[1] & 1 else ">", 16
            seconds, nanoseconds, size = struct.unpack_from(order + "iII", raw, 4)
    except (struct.error, IndexError):
        raise DataError(f"a message of {len(raw)} bytes is too short for its header") from None
    if start + size > len(raw):
        raise DataError(f"a message of {len(raw)} bytes ends within its header")
    frame = bytes(raw[start : start + size]).rstrip(b"\0").decode("utf-8", "replace")
    return Header(seconds * NS_PER_S + nanoseconds, frame.lstrip("/"), start + size, order)


def read_imu(raw: bytes, header: Header, is_ros2: bool) -> tuple[float, ...]:
    """Return angular velocity (rad/s) and specific force (m/s²) of a ``sensor_msgs/Imu``; NaN for what it lacks.

    Behind the header there are 37 numbers: orientation (4) and its covariance (9), then each vector (3) and its
    covariance (9). A vector that a driver does not measure is zero, and its covariance begins with -1.

    Raises:
        DataError: the message is too short.
    """
    at = _aligned(header.end, 8) if is_ros2 else header.end
    try:
        rate = struct.unpack_from(header.order + "4d", raw, at + 8 * 13)
        force = struct.unpack_from(header.order + "4d", raw, at + 8 * 25)
    except struct.error:
        raise DataError("an inertial message is too short") from None
    return measured(rate[:3], rate[3]) + measured(force[:3], force[3])


def measured(vector: tuple[float, ...], variance: float) -> tuple[float, ...]:
    """Return a vector of an inertial message, or NaN if the message says that it is not measured."""
    return (np.nan,) * 3 if variance == -1.0 and not any(vector) else vector


def read_livox(raw: bytes, is_ros2: bool) -> tuple[int, NDArray[Any]]:
    """Read a Livox ``CustomMsg``.

    Returns:
        ``timebase`` in ns, and a structured array with the fields ``offset_time`` (ns after it), ``x y z`` (m),
        ``reflectivity`` (0..255), ``tag`` and ``line``.

    Raises:
        DataError: the message ends before its last point.
    """
    header = read_header(raw, is_ros2)
    at = _aligned(header.end, 8) if is_ros2 else header.end
    try:
        (timebase_ns,) = struct.unpack_from(header.order + "Q", raw, at)
        (count,) = struct.unpack_from(header.order + "I", raw, at + 16)  # after point_num, lidar_id and 3 bytes
    except struct.error:
        raise DataError("the Livox message ends within its header") from None
    step = 20 if is_ros2 else _LIVOX_BYTES  # CDR starts every point at a multiple of 4
    data = bytes(raw[at + 20 : at + 20 + count * step])
    if len(data) < count * step - (step - _LIVOX_BYTES):
        raise DataError(f"the Livox message ends before the last of its {count} points")
    kind = np.dtype(
        {
            "names": list(_LIVOX_FIELDS),
            "formats": [header.order + kind for kind in _LIVOX_KINDS],
            "offsets": [0, 4, 8, 12, 16, 17, 18],
            "itemsize": step,
        }
    )
    return timebase_ns, np.frombuffer(data.ljust(count * step, b"\0"), kind)


def _aligned(position: int, size: int) -> int:
    """Return the next position of a field of ``size`` bytes; CDR counts from the end of its own four bytes."""
    return 4 + -(-(position - 4) // size) * size
