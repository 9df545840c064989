"""The summary of an MCAP file, made again from its chunks (https://mcap.dev/spec)."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import BinaryIO

from hybridlio.core.errors import DataError

_MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _MESSAGE_INDEX, _CHUNK_INDEX = 2, 3, 4, 5, 6, 7, 8
_DATA_END, _FIRST_OWN = 15, 0x80  # kinds between them are reserved; from there on they are the writers' own
_LARGEST_COMPRESSED = 1 << 30  # bytes of a chunk; writers cut them at some megabytes


@dataclass
class _Chunk:
    """A chunk: where it starts, its bytes with those of the record's head, its header, and where its indexes start."""

    at: int
    size: int
    start_ns: int
    end_ns: int
    raw_bytes: int
    compression: str
    data_at: int
    data_bytes: int
    indexes_at: dict[int, int] = field(default_factory=dict)
    indexes_bytes: int = 0

    def index(self) -> bytes:
        """Return the record that describes the chunk in a summary."""
        offsets = b"".join(struct.pack("<HQ", *item) for item in self.indexes_at.items())
        name = self.compression.encode()
        content = struct.pack("<QQQQI", self.start_ns, self.end_ns, self.at, self.size, len(offsets)) + offsets
        content += struct.pack("<QI", self.indexes_bytes, len(name)) + name
        return _record(_CHUNK_INDEX, content + struct.pack("<QQ", self.data_bytes, self.raw_bytes))


def mcap_index(file: BinaryIO, size: int) -> tuple[bytes, int, bytes, int]:
    """Return what replaces the start of the file (nothing), the end of its whole records, the summary, and the chunks.

    A file whose messages stand outside chunks, or whose chunks have no indexes, gets an empty summary: ``rosbags`` then
    passes over all of it.

    Raises:
        DataError: the file is no MCAP file, or it has neither a whole chunk nor a whole message.
    """
    if file.read(len(_MAGIC)) != _MAGIC:
        raise DataError("no MCAP file")
    chunks: list[_Chunk] = []
    known: dict[tuple[int, int], bytes] = {}
    messages, end = 0, len(_MAGIC)
    for op, at, length in _records(file, size):
        if op in (_DATA_END, _FOOTER):
            break
        if op == _CHUNK:
            chunks.append(_chunk(file, at, length))
        elif op == _MESSAGE_INDEX and chunks:
            (channel,) = struct.unpack("<H", file.read(2))
            chunks[-1].indexes_at[channel] = at
            chunks[-1].indexes_bytes += 9 + length
        elif op in (_SCHEMA, _CHANNEL):
            _keep(known, op, file.read(length))
        messages += op == _MESSAGE
        end = at + 9 + length
    if not chunks and not messages:
        raise DataError("no whole chunk")
    if messages or not all(chunk.indexes_at for chunk in chunks[:-1]):
        return b"", end, _footer(0), len(chunks)
    whole = [chunk for chunk in chunks if chunk.indexes_at]
    if not whole:
        raise DataError("no whole chunk")
    _find_channels(file, whole, known)
    # schemas first, as channels refer to them
    summary = b"".join(_record(op, content) for (op, _), content in sorted(known.items()))
    return b"", end, summary + b"".join(chunk.index() for chunk in whole) + _footer(end), len(whole)


def _records(file: BinaryIO, size: int) -> Iterator[tuple[int, int, int]]:
    """Yield kind, position and length of the records as long as they are whole; the file is then at their content."""
    at = len(_MAGIC)
    while at + 9 <= size:
        file.seek(at)
        op, length = struct.unpack("<BQ", file.read(9))
        if not op or _DATA_END < op < _FIRST_OWN or at + 9 + length > size:
            return
        yield op, at, length
        at += 9 + length


def _chunk(file: BinaryIO, at: int, length: int) -> _Chunk:
    start_ns, end_ns, raw_bytes, _, name_bytes = struct.unpack("<QQQII", file.read(32))
    name = file.read(min(name_bytes, length)).decode("ascii", "replace")
    (data_bytes,) = struct.unpack("<Q", file.read(8))
    return _Chunk(at, 9 + length, start_ns, end_ns, raw_bytes, name, file.tell(), min(data_bytes, _LARGEST_COMPRESSED))


def _find_channels(file: BinaryIO, chunks: list[_Chunk], known: dict[tuple[int, int], bytes]) -> None:
    """Add the channels and schemas that stand in the chunks before the first message of each channel."""
    from rosbags.rosbag2.storage_mcap import decompress

    for chunk in chunks:
        if all((_CHANNEL, channel) in known for channel in chunk.indexes_at):
            continue
        file.seek(chunk.data_at)
        data = decompress(file.read(chunk.data_bytes), chunk.compression, chunk.raw_bytes, 0)
        at = 0
        while at + 9 <= len(data):
            op, length = struct.unpack_from("<BQ", data, at)
            if op in (_SCHEMA, _CHANNEL):
                _keep(known, op, data[at + 9 : at + 9 + length])
            at += 9 + length


def _keep(known: dict[tuple[int, int], bytes], op: int, content: bytes) -> None:
    known.setdefault((op, int.from_bytes(content[:2], "little")), content)


def _record(op: int, content: bytes) -> bytes:
    return struct.pack("<BQ", op, len(content)) + content


def _footer(summary_at: int) -> bytes:
    return _record(_FOOTER, struct.pack("<QQI", summary_at, 0, 0)) + _MAGIC
