"""A bag, opened through the library ``rosbags``: its topics, and its messages in order of receipt."""

from __future__ import annotations

import weakref
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hybridlio.core.errors import DataError, HybridLioError
from hybridlio.core.sensors import NS_PER_S
from hybridlio.datasets.rosbag.heads import messages_and_heads
from hybridlio.datasets.rosbag.recovery import RecoveredFile
from hybridlio.datasets.rosbag.spans import span_of

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.typesys.store import Typestore

ROS_1, ROS_2_FILES = ".bag", (".mcap", ".db3")
METADATA = "metadata.yaml"  # of a ROS 2 folder

_POINT = "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line\n"
_CLOUD = (
    "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\nCustomPoint[] points\n"
)
LIVOX_PACKAGES = ("livox_ros_driver", "livox_ros_driver2", "livox_interfaces")
_REMEDIES = {
    ".bag": "rosbag reindex",
    ".mcap": "mcap recover",
    ".db3": "sqlite3 .recover",
}
# whole files that are not of ROS, by what the library says of them
_FOREIGN = {
    "Profile is not ros2": "an MCAP file of another system, not of ROS 2; record or convert it with the profile 'ros2'",
    "Serialization format": "its messages are not serialised as ROS 2 does (CDR); record or convert it as CDR",
}


@dataclass(frozen=True)
class Topic:
    """A topic of a bag.

    Attributes:
        name: such as ``/points``.
        type: such as ``sensor_msgs/PointCloud2``, the same for ROS 1 and ROS 2.
        count: number of messages.
        rate_hz: messages per second from the topic's first message to its last; 0 where the bag's index does not tell
            them, and for fewer than two messages.
    """

    name: str
    type: str
    count: int
    rate_hz: float


@contextmanager
def readable(path: Path) -> Iterator[None]:
    """Turn any error of the bag's library into one :class:`DataError` that names the bag and a remedy.

    The library raises errors of a dozen types where a file is damaged, assertions and those of struct, SQLite and the
    compression libraries among them.
    """
    try:
        yield
    except HybridLioError:
        raise
    except Exception as error:
        text = " ".join(str(error).split()) or type(error).__name__
        if foreign := next((reason for sign, reason in _FOREIGN.items() if sign in text), None):
            raise DataError(f"{path}: {foreign}") from None
        remedy = _REMEDIES.get(path.suffix, "ros2 bag reindex")
        raise DataError(
            f"{path}: cannot be read, the bag is truncated or damaged ({text[:160]}); `{remedy}` may repair it"
        ) from None


class Bag:
    """A bag that is open until it is garbage-collected.

    Attributes:
        path: the bag's file or folder.
        is_ros2: whether messages are serialised as CDR.
        topics: its topics with at least one message, by name.
        recovered: what was lost, for each file whose index was made again.
    """

    def __init__(self, path: Path) -> None:
        """Open a bag: read its index, and no message. An index that is missing is made again.

        Raises:
            DataError: the files are missing, truncated or damaged.
        """
        self.path, parts = path, bag_files(path)
        self.is_ros2 = parts[0].suffix != ROS_1
        self._connections: dict[str, list[Any]] = {}
        self._types: dict[str, str] = {}
        with readable(path):
            self._reader, self.recovered = _open_or_recover(parts)
            weakref.finalize(self, _close, self._reader)
            for connection in self._reader.connections:
                self._connections.setdefault(connection.topic, []).append(connection)
                self._types[connection.topic] = connection.msgtype
            # metadata of ROS 2 may hold words in the place of numbers
            counts = {name: sum(c.msgcount for c in found) for name, found in self._connections.items()}
            self.topics = {
                name: Topic(name, self._types[name].replace("/msg/", "/"), count, self._rate_hz(name, count))
                for name, count in sorted(counts.items())
                if count
            }

    def _rate_hz(self, topic: str, count: int) -> float:
        try:
            span = span_of(self._connections[topic])
        except Exception:  # of the library, or of a damaged index; messages may be readable all the same
            span = None
        if span is None or span[1] <= span[0]:
            return 0.0
        return (count - 1) * NS_PER_S / (span[1] - span[0])

    @property
    def duration_s(self) -> float:
        """Seconds from the first message to the last."""
        return max(self._reader.duration, 0) / NS_PER_S

    def messages(self, topics: Collection[str], start_ns: int | None = None) -> Iterator[tuple[str, int, bytes]]:
        """Yield topic, time of receipt in ns and serialised message, in order of receipt from ``start_ns`` on.

        Use one iterator at a time: they share the file's position.

        Raises:
            DataError: the bag is damaged.
        """
        connections = [c for topic in topics for c in self._connections[topic]]
        if not connections:
            return
        with readable(self.path):
            for connection, received_ns, raw in self._reader.messages(connections, start=start_ns):
                yield connection.topic, received_ns, raw

    def messages_and_heads(self, topics: Collection[str], cut: Collection[str]) -> Iterator[tuple[str, int, bytes]]:
        """As :meth:`messages`, of the topics ``cut`` at least the first kilobyte of each message.

        Raises:
            DataError: the bag is damaged.
        """
        connections = [c for topic in topics for c in self._connections[topic]]
        with readable(self.path):
            yield from messages_and_heads(connections, cut)

    def decode(self, topic: str, raw: bytes) -> Any:
        """Return a message as an object whose attributes are the fields of its ROS type.

        Raises:
            DataError: the bytes do not fit the type.
        """
        name = self._types[topic]
        with readable(self.path):
            store = self._reader.typestore if name in self._reader.typestore.fielddefs else _known_types()
            return store.deserialize_cdr(raw, name) if self.is_ros2 else store.deserialize_ros1(raw, name)


def bag_files(path: Path) -> list[Path]:
    """Return the files to open for a recording: the path itself, or the parts in a folder without ``metadata.yaml``."""
    if path.is_file() or (path / METADATA).is_file():
        return [path]
    for suffix in (*ROS_2_FILES, ROS_1):
        if parts := sorted(path.glob(f"*{suffix}"), key=part_number):
            return parts
    raise DataError(f"{path}: no bag; give a .bag, .mcap or .db3 file, or a folder of ROS 2")


def part_number(path: Path) -> tuple[int, str]:
    """Return the number at the end of the name of a split bag's part (-1 without one), and the name."""
    tail = path.stem.rpartition("_")[2]
    return int(tail) if tail.isdigit() else -1, path.name


def _close(reader: AnyReader) -> None:
    """Close a reader that nobody uses any more; SQLite refuses while an iterator over its messages is unfinished."""
    with suppress(Exception):
        reader.close()


def _open_or_recover(parts: list[Path]) -> tuple[AnyReader, list[str]]:
    """Return the open reader, and notes on files whose index was made again."""
    try:
        return _open(parts), []
    except Exception:  # of a dozen types, see readable()
        files = _parts_without_metadata(parts)
        try:
            whole = [_whole_or_recovered(file) for file in files]
        except Exception:
            whole = []
        notes = [file.note for file in whole if isinstance(file, RecoveredFile)]
        if not notes:
            raise
        return _open(whole), notes


def _parts_without_metadata(parts: list[Path]) -> list[Path]:
    """Return the files of a folder whose ``metadata.yaml`` may count messages that are lost."""
    (first, *others) = parts
    return parts if others or first.is_file() else sorted(first.glob("*.mcap"), key=part_number)


def _whole_or_recovered(file: Path) -> Path | RecoveredFile:
    try:
        _close(_open([file]))
    except Exception:
        return RecoveredFile(file)
    return file


def _open(parts: Sequence[Path | RecoveredFile]) -> AnyReader:
    from rosbags.highlevel import AnyReader, AnyReaderError

    reader = AnyReader(parts)
    try:
        reader.open()
    except AnyReaderError as error:
        if "no type definitions" not in str(error):
            raise
        reader = AnyReader(parts, default_typestore=_known_types())  # ROS 2 before 2023 stores none in SQLite
        reader.open()
    return reader


def _known_types() -> Typestore:
    """Return the message types of ROS 2, and Livox's, which are not part of ROS."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.LATEST)
    for package in LIVOX_PACKAGES:
        store.register(get_types_from_msg(_POINT, f"{package}/msg/CustomPoint"))
        cloud = _CLOUD.replace("CustomPoint", f"{package}/CustomPoint")
        store.register(get_types_from_msg(cloud, f"{package}/msg/CustomMsg"))
    return store
