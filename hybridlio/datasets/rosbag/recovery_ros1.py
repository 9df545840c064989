"""The index of a ROS 1 bag, made again from its chunks (http://wiki.ros.org/Bags/Format/2.0)."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import BinaryIO

from hybridlio.core.errors import DataError

_MAGIC = b"#ROSBAG V2.0\n"
_BAG_HEADER, _INDEX, _CHUNK, _CONNECTION = 3, 4, 5, 7
_LARGEST_HEADER = 1 << 20  # a record's header holds names and numbers; a connection's in a damaged file may claim more
_NS = 1_000_000_000


@dataclass
class _Chunk:
    """A chunk: where it starts, its data, and for each connection the count of its messages."""

    at: int
    data_at: int
    data_bytes: int
    compression: str
    counts: dict[int, int] = field(default_factory=dict)
    times_ns: list[int] = field(default_factory=list)

    def info(self) -> bytes:
        """Return the record that describes the chunk in an index."""
        header = _fields(
            ver=struct.pack("<I", 1),
            chunk_pos=struct.pack("<Q", self.at),
            start_time=_time(min(self.times_ns)),
            end_time=_time(max(self.times_ns)),
            count=struct.pack("<I", len(self.counts)),
            op=b"\x06",
        )
        return _record(header, b"".join(struct.pack("<II", *item) for item in self.counts.items()))


def ros1_index(file: BinaryIO, size: int) -> tuple[bytes, int, bytes, int]:
    """Return what replaces the start of a bag, the end of its whole chunks, the index to put there, and their number.

    Raises:
        DataError: the file is no bag, or it has no whole chunk.
    """
    start = file.read(len(_MAGIC))
    if start != _MAGIC:
        raise DataError("no ROS 1 bag")
    chunks: list[_Chunk] = []
    end = len(_MAGIC)
    for op, header, at, data_at, data_bytes in _records(file, size):
        if op == _CHUNK:
            chunks.append(_Chunk(at, data_at, data_bytes, header.get("compression", b"").decode("ascii", "replace")))
        elif op == _INDEX and chunks:
            _add(chunks[-1], header, file, data_at, data_bytes)
        elif op not in (_BAG_HEADER, _INDEX):
            break  # what is left of the old index
        end = data_at + data_bytes
    whole = [chunk for chunk in chunks if chunk.counts]
    if not whole:
        raise DataError("no whole chunk")
    connections = _connections(file, whole)
    index = b"".join(connections.values()) + b"".join(chunk.info() for chunk in whole)
    return _patched(file, end, len(connections), len(whole)), end, index, len(whole)


def _records(file: BinaryIO, size: int) -> Iterator[tuple[int, dict[str, bytes], int, int, int]]:
    """Yield kind, header, position, position of the data and their bytes, as long as records are whole."""
    at = file.tell()
    while at + 8 <= size:
        file.seek(at)
        (header_bytes,) = struct.unpack("<I", file.read(4))
        if header_bytes > _LARGEST_HEADER or at + 8 + header_bytes > size:
            return
        header = _parsed(file.read(header_bytes))
        (data_bytes,) = struct.unpack("<I", file.read(4))
        data_at = at + 8 + header_bytes
        if len(header.get("op", b"")) != 1 or data_at + data_bytes > size:
            return
        yield header["op"][0], header, at, data_at, data_bytes
        at = data_at + data_bytes


def _parsed(header: bytes) -> dict[str, bytes]:
    fields, at = {}, 0
    while at + 4 <= len(header):
        (length,) = struct.unpack_from("<I", header, at)
        name, _, value = header[at + 4 : at + 4 + length].partition(b"=")
        fields[name.decode("ascii", "replace")] = value
        at += 4 + length
    return fields


def _add(chunk: _Chunk, header: dict[str, bytes], file: BinaryIO, data_at: int, data_bytes: int) -> None:
    """Add the index of one connection's messages in a chunk."""
    count = data_bytes // 12
    if len(header.get("conn", b"")) != 4 or not count:
        return
    file.seek(data_at)
    rows = list(struct.iter_unpack("<III", file.read(12 * count)))
    chunk.counts[struct.unpack("<I", header["conn"])[0]] = count
    chunk.times_ns += [min(row[0] * _NS + row[1] for row in rows), max(row[0] * _NS + row[1] for row in rows)]


def _connections(file: BinaryIO, chunks: list[_Chunk]) -> dict[int, bytes]:
    """Return the records that describe the connections, which stand in the chunks before their first message."""
    from rosbags.rosbag1.reader import decompressors

    found: dict[int, bytes] = {}
    for chunk in chunks:
        if chunk.counts.keys() <= found.keys():
            continue
        file.seek(chunk.data_at)
        data = decompressors[chunk.compression](file.read(chunk.data_bytes))
        at = 0
        while at + 8 <= len(data):
            (header_bytes,) = struct.unpack_from("<I", data, at)
            header = _parsed(data[at + 4 : at + 4 + header_bytes])
            (data_bytes,) = struct.unpack_from("<I", data, at + 4 + header_bytes)
            end = at + 8 + header_bytes + data_bytes
            if header.get("op") == bytes([_CONNECTION]):
                found.setdefault(struct.unpack("<I", header["conn"])[0], data[at:end])
            at = end
    return found


def _patched(file: BinaryIO, index_at: int, connections: int, chunks: int) -> bytes:
    """Return the start of the file with a bag header that names the new index."""
    file.seek(len(_MAGIC))
    (header_bytes,) = struct.unpack("<I", file.read(4))
    data_at = len(_MAGIC) + 4 + header_bytes
    header = bytearray(file.read(header_bytes))
    values = (
        (b"index_pos=", struct.pack("<Q", index_at)),
        (b"conn_count=", struct.pack("<I", connections)),
        (b"chunk_count=", struct.pack("<I", chunks)),
    )
    for name, value in values:
        at = header.find(name)
        if at < 0:
            raise DataError("the bag's header is damaged")
        header[at + len(name) : at + len(name) + len(value)] = value
    file.seek(0)
    return file.read(len(_MAGIC) + 4) + bytes(header) + _rest(file, data_at)


def _rest(file: BinaryIO, at: int) -> bytes:
    file.seek(at)
    return file.read(4)


def _time(ns: int) -> bytes:
    return struct.pack("<II", *divmod(ns, _NS))


def _fields(**values: bytes) -> bytes:
    parts = [name.encode() + b"=" + value for name, value in values.items()]
    return b"".join(struct.pack("<I", len(part)) + part for part in parts)


def _record(header: bytes, data: bytes) -> bytes:
    return struct.pack("<I", len(header)) + header + struct.pack("<I", len(data)) + data
