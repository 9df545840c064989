"""Reader of recordings of an Ouster's packets (``.pcap`` with its ``.json``, ``.osf``), by the library ouster-sdk.

Points are in the sensor's frame; where its IMU is comes from the sensor's own metadata.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
    """Yield stamp and columns of each turn: of its valid columns the points of every return.

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
        returns = [returned(frame, place, valid, suffix) for suffix in ("", "2") if f"RANGE{suffix}" in frame.fields]
        xyz, reflectivity, rows, columns = (np.concatenate(parts) for parts in zip(*returns, strict=True))
        points = dict(zip("xyz", xyz.T, strict=True))
        yield stamp, points | {"reflectivity": reflectivity, "ring": rows, "t": stamps[columns] - stamp}


def returned(
    frame: Any, place: Any, valid: NDArray[np.intp], suffix: str
) -> tuple[NDArray[Any], NDArray[Any], NDArray[np.intp], NDArray[np.intp]]:
    """Return points ``(N, 3)``, reflectivities, rows and columns of one return of a turn.

    Args:
        frame: ouster-sdk's scan.
        place: its table of directions.
        valid: the columns to use.
        suffix: of the fields' names: none for the first return, ``2`` for the second of a sensor with two.
    """
    ranges = np.asarray(frame.field(f"RANGE{suffix}"))
    keep = np.zeros(ranges.shape, dtype=bool)
    keep[:, valid] = ranges[:, valid] > 0
    rows, columns = np.nonzero(keep)
    name = f"REFLECTIVITY{suffix}"
    reflectivity = np.asarray(frame.field(name))[keep] if name in frame.fields else np.zeros(len(rows), np.uint8)
    return np.asarray(place(ranges))[keep], reflectivity, rows, columns


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
