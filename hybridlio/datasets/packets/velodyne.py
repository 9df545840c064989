"""Reader of captures of a Velodyne's packets (``.pcap``), decoded by the library velodyne-decoder."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hybridlio.core.errors import DataError
from hybridlio.core.sensors import NS_PER_S, ImuSamples
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.packets.streamed import Turns, packet_sequence
from hybridlio.datasets.points.point_times import StatedTimes
from hybridlio.datasets.sequence import Sequence

LAYOUT = "a .pcap file of a Velodyne's packets"
SUFFIXES = (".pcap",)


def find(path: Path) -> dict[str, Path]:
    """Find the capture at ``path``."""
    return {path.stem: path} if path.is_file() and path.suffix in SUFFIXES else {}


def read_turns(path: Path) -> Turns:
    """Yield stamp and columns of each turn; the times of points are seconds after the stamp.

    Stamps are the sensor's, which counts from the full hour: the hour is that of the capture.

    Raises:
        DataError: velodyne-decoder is not installed.
    """
    try:
        import velodyne_decoder
    except ImportError:
        raise DataError(f"{path}: needs velodyne-decoder: pip install 'hybridlio[velodyne]'") from None
    for stamp, points in velodyne_decoder.read_pcap(str(path), velodyne_decoder.Config(), as_pcl_structs=True):
        columns = {name: np.array(points[name]) for name in ("x", "y", "z", "intensity", "ring", "time")}
        yield round(stamp.device * NS_PER_S), columns


def open_capture(path: Path, vertical_angle_deg: float | None = None) -> Sequence:
    """Open a capture.

    Raises:
        DataError: the packets cannot be decoded, or velodyne-decoder is not installed.
        ConfigError: ``vertical_angle_deg`` is over 5°.
    """
    notes = Notes(path.stem)
    notes.add("no inertial data: a Velodyne's packets hold none that is used")
    times = StatedTimes("time", "s", "stamp")
    return packet_sequence(path, read_turns, times, ImuSamples.empty(), np.eye(4), notes, vertical_angle_deg)
