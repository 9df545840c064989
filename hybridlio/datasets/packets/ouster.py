"""Reader of recordings of an Ouster's packets (``.pcap`` with its ``.json``, ``.osf``), by the library ouster-sdk.

Points are in the sensor's frame; where its IMU is comes from the sensor's own metadata.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.core.sensors import ImuSamples
from hybridlio.datasets.imu_columns import STANDARD_GRAVITY_M_S2
from hybridlio.datasets.imu_csv import clean_imu
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.packets.streamed import Turns, decoding, packet_sequence
from hybridlio.datasets.points.point_times import StatedTimes
from hybridlio.datasets.sequence import Sequence

LAYOUT = "a .pcap file of an Ouster's packets beside its .json, or an .osf file"
SUFFIXES = (".pcap", ".osf")
# ouster-sdk asks for an old release of rosbags, which only its own converter uses
_HOW = "needs ouster-sdk: pip install --no-deps ouster-sdk more-itertools"


def find(path: Path) -> dict[str, Path]:
    """Find the recording at ``path``; a ``.pcap`` needs a ``.json`` of metadata beside it."""
    if not path.is_file() or path.suffix not in SUFFIXES or (path.suffix == ".pcap" and metadata(path) is None):
        return {}
    return {path.stem: path}


def metadata(path: Path) -> Path | None:
    """Return the ``.json`` beside a capture: that with the longest name which the capture's begins with, or None."""
    beside = [file for file in path.parent.glob("*.json") if path.stem.startswith(file.stem)]
    return max(beside, key=lambda file: len(file.stem), default=None)


def _sdk(path: Path) -> Any:
    try:
        from ouster import sdk
        from ouster.sdk import core
    except ImportError:
        raise DataError(f"{path}: {_HOW}") from None
    return sdk, core


def _meta(path: Path) -> dict[str, Any]:
    file = metadata(path) if path.suffix == ".pcap" else None
    return {"meta": [str(file)]} if file is not None else {}


def read_turns(path: Path) -> Turns:
    """Yield stamp and columns of each turn: of its valid columns the points with a return.

    Raises:
        DataError: ouster-sdk is not installed.
    """
    sdk, core = _sdk(path)
    source = sdk.open_source(str(path), sensor_idx=0, **_meta(path))
    place = core.XYZLut(source.sensor_info[0])
    for frames in source:
        frame = frames[0]
        valid = np.flatnonzero(np.asarray(frame.status) & 1)
        if not len(valid):
            continue
        stamps = np.asarray(frame.timestamp, dtype=np.int64)
        stamp = int(stamps[valid[0]])
        keep = np.zeros((frame.h, frame.w), dtype=bool)
        keep[:, valid] = np.asarray(frame.field("RANGE"))[:, valid] > 0
        xyz = np.asarray(place(frame))[keep]
        rows, columns = np.nonzero(keep)
        yield (
            stamp,
            {
                **dict(zip("xyz", xyz.T, strict=True)),
                "reflectivity": np.asarray(frame.field("REFLECTIVITY"))[keep],
                "ring": rows,
                "t": stamps[columns] - stamp,
            },
        )


def open_recording(path: Path, vertical_angle_deg: float | None = None) -> Sequence:
    """Open a recording.

    Raises:
        DataError: the packets cannot be decoded, or ouster-sdk is not installed.
        ConfigError: ``vertical_angle_deg`` is over 5°.
    """
    notes = Notes(path.stem)
    with decoding(path):
        imu, T_imu_sensor = _imu(path, notes)
    times = StatedTimes("t", "ns", "stamp")
    return packet_sequence(path, read_turns, times, imu, T_imu_sensor, notes, vertical_angle_deg)


def _imu(path: Path, notes: Notes) -> tuple[ImuSamples, Array]:
    """Return the samples of the sensor's own IMU, in its frame, and ``T_imu_sensor``."""
    sdk, core = _sdk(path)
    if path.suffix == ".osf":
        notes.add("no inertial data: those of .osf files are not read")
        return ImuSamples.empty(), np.eye(4)
    source = sdk.open_packet_source(str(path), **_meta(path))
    info = source.sensor_info[0]
    layout = core.PacketFormat(info)
    stamps, rows = [], []
    for _, packet in source:
        if isinstance(packet, core.ImuPacket):
            data = packet.buf
            stamps.append(int(layout.imu_gyro_ts(data)))
            rates = (layout.imu_av_x(data), layout.imu_av_y(data), layout.imu_av_z(data))
            rows.append((*rates, layout.imu_la_x(data), layout.imu_la_y(data), layout.imu_la_z(data)))
    T_sensor_imu = np.array(info.imu_to_sensor_transform, dtype=np.float64)
    T_sensor_imu[:3, 3] /= 1000  # millimetres
    T_imu_sensor = np.asarray(se3.inverse(se3.check_pose(T_sensor_imu, f"{path}: imu_to_sensor_transform")))
    if not rows:
        notes.add("no inertial data: no IMU packets in the capture")
        return ImuSamples.empty(), T_imu_sensor
    # °/s and g, by Ouster's software manual
    values = np.array(rows) * [*[np.pi / 180] * 3, *[STANDARD_GRAVITY_M_S2] * 3]
    return clean_imu(str(path), np.array(stamps, dtype=np.int64), values, notes), T_imu_sensor
