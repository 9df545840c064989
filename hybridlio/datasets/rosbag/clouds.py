"""The columns of point cloud messages."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridlio.core.errors import DataError
from hybridlio.datasets.points.point_times import StatedTimes
from hybridlio.datasets.rosbag.wire import read_livox

Columns = dict[str, NDArray[Any]]

# sensor_msgs/PointField: INT8, UINT8, INT16, UINT16, INT32, UINT32, FLOAT32, FLOAT64
_KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
LIVOX_TIMES = StatedTimes("offset_time", "ns", "stamp")  # as :func:`livox_columns` gives them
_MAX_POINT_BYTES = 1 << 16  # hundreds of times as many as any driver writes; NumPy refuses 2 GiB
_MAX_TIMEBASE_NS = 1_000_000_000  # no lidar turns slower: a timebase farther from the stamp is on another clock


def cloud_columns(message: Any) -> Columns:
    """Return the columns of a ``sensor_msgs/PointCloud2`` by lower-case name, ``(N,)`` each; they share memory with it.

    Raises:
        DataError: the message has fewer bytes than it announces, no fields ``x y z``, or a field that does not fit.
    """
    kind = _point_type(message)
    missing = [axis for axis in "xyz" if axis not in (kind.names or ())]
    if missing:
        raise DataError(f"the cloud has no field {missing[0]}; its fields are {', '.join(kind.names or ()) or 'none'}")
    points = _points(message, kind)
    return {name: points[name] for name in kind.names or ()}


def livox_columns(raw: bytes, is_ros2: bool, stamp_ns: int) -> Columns:
    """Return the columns of a Livox ``CustomMsg``; ``offset_time`` is in ns after the stamp.

    The points' times count from the message's ``timebase``. Drivers set the stamp to it, or to another clock: then
    times count from the stamp.
    """
    timebase_ns, points = read_livox(raw, is_ros2)
    columns: Columns = {name: points[name] for name in ("x", "y", "z", "reflectivity", "tag", "line")}
    shift_ns = timebase_ns - stamp_ns if abs(timebase_ns - stamp_ns) < _MAX_TIMEBASE_NS else 0
    columns["offset_time"] = points["offset_time"].astype(np.int64) + shift_ns
    return columns


def _point_type(message: Any) -> np.dtype[Any]:
    order = ">" if message.is_bigendian else "<"
    formats, offsets, names = [], [], []
    if message.point_step > _MAX_POINT_BYTES:
        raise DataError(f"points of the cloud have {message.point_step} bytes each; the message is damaged")
    for field in message.fields:
        if field.datatype not in _KINDS:
            raise DataError(f"field {field.name!r} of the cloud has the unknown type {field.datatype}")
        count = max(int(field.count), 1)  # some drivers leave 0 for a scalar
        kind = np.dtype(order + _KINDS[field.datatype])
        if field.offset + count * kind.itemsize > message.point_step:
            raise DataError(f"field {field.name!r} of the cloud lies outside its {message.point_step} bytes per point")
        name = field.name.lower()
        if count == 1 and name and name not in names:  # vectors are no columns
            formats.append(kind)
            offsets.append(field.offset)
            names.append(name)
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": message.point_step})


def _points(message: Any, kind: np.dtype[Any]) -> NDArray[Any]:
    data, width, height = message.data, int(message.width), int(message.height)
    row, used = int(message.row_step), width * kind.itemsize
    if height == 1:  # row_step is redundant, and left 0 by some drivers
        row = used
    if row < used:
        raise DataError(f"rows of the cloud have {row} bytes, too few for {width} points of {kind.itemsize} bytes")
    if len(data) < row * (height - 1) + used or (height and not kind.itemsize):
        raise DataError(f"the cloud has {len(data)} bytes, but {height} rows of {row}; the message is truncated")
    if row == used or height == 1:
        return np.frombuffer(data, kind, count=width * height)
    padded = np.frombuffer(data, np.uint8, count=row * (height - 1) + used)
    rows = np.lib.stride_tricks.as_strided(padded, (height, used), (row, 1))
    return np.ascontiguousarray(rows).view(kind).ravel()
