"""The first bytes of large messages, in order of receipt, without reading the rest of them.

Opening a bag takes the stamps of its clouds, which are nearly all of its bytes. Where the storage allows it, as SQLite
and chunks without compression do, only the first bytes of each cloud are read from the file; compressed chunks are
decompressed up to there. ``rosbags`` finds the messages; it reads each one whole.
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator
from heapq import merge
from typing import Any

from hybridlio.core.errors import DataError
from hybridlio.datasets.rosbag.chunk_start import ChunkStart

HEAD_BYTES = 1024  # of a message: the stamp, and the name of a frame
_RECORD = struct.Struct("<BQ")  # MCAP, https://mcap.dev/spec: kind and length of a record
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, time of receipt, time of publication
_MESSAGE_KIND = 5

Message = tuple[str, int, bytes]  # topic, time of receipt in ns, bytes


def messages_and_heads(connections: list[Any], cut: Collection[str]) -> Iterator[Message]:
    """Yield messages in order of receipt: of the topics ``cut`` at least the first :data:`HEAD_BYTES` of each.

    Args:
        connections: of an open bag, those to read.
        cut: topics of large messages.
    """
    owners = {id(c.owner): c.owner for c in connections}.values()
    parts = [_of_owner(owner, [c for c in connections if c.owner is owner], cut) for owner in owners]
    return iter(parts[0]) if len(parts) == 1 else merge(*parts, key=lambda message: message[1])


def _of_owner(owner: Any, connections: list[Any], cut: Collection[str]) -> Iterator[Message]:
    """Yield the messages of one ROS 1 file, ROS 2 file or ROS 2 folder."""
    from rosbags.rosbag1 import Reader
    from rosbags.rosbag2.reader import DirectoryReader
    from rosbags.rosbag2.storage_mcap import McapReader
    from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

    if isinstance(owner, DirectoryReader) and owner.metadata.compression_mode != "message":
        for storage in owner.storages:
            if kept := [c for c in storage.connections if any(is_part(c, whole) for whole in connections)]:
                yield from _of_owner(storage, kept, cut)
    elif isinstance(owner, Sqlite3Reader):
        yield from _sqlite(owner, connections, cut)
    elif isinstance(owner, McapReader) and owner.chunks:
        yield from _mcap(owner, connections, cut)
    elif isinstance(owner, Reader):
        yield from _ros1(owner, connections, cut)
    else:
        for connection, received_ns, raw in owner.messages(connections):
            yield connection.topic, received_ns, raw


def is_part(part: Any, whole: Any) -> bool:
    """Return whether a connection of a folder's file is one of the folder, by the rule of ``rosbags``."""
    same = part.topic == whole.topic and part.msgtype == whole.msgtype and part.ext == whole.ext
    return same and (not part.digest or not whole.digest or part.digest == whole.digest)


def _sqlite(storage: Any, connections: list[Any], cut: Collection[str]) -> Iterator[Message]:
    topics = {c.id: c.topic for c in connections}
    places = ",".join("?" for _ in topics)
    query = f"SELECT id, topic_id, timestamp FROM messages WHERE topic_id IN ({places}) ORDER BY timestamp"
    blob = None
    for row, topic_id, received_ns in storage.dbconn.execute(query, tuple(topics)):
        if blob is None:
            blob = storage.dbconn.blob_open("main", "messages", "data", row, False)
        else:
            blob.reopen(row)
        size = blob.length()
        yield topics[topic_id], received_ns, blob.read(min(size, HEAD_BYTES) if topics[topic_id] in cut else size)


def _mcap(storage: Any, connections: list[Any], cut: Collection[str]) -> Iterator[Message]:
    channels = {c.id: c for c in connections}
    chunks = [c for c in storage.chunks if any(c.channel_count.get(channel, 0) for channel in channels)]
    for received_ns, offset, connection, raw in merge(*(_of_chunk(storage.bio, c, channels, cut) for c in chunks)):
        if offset:
            yield connection.topic, received_ns, raw


def _of_chunk(bag: Any, chunk: Any, channels: dict[int, Any], cut: Collection[str]) -> Iterator[Any]:
    """Yield the messages of a chunk as ``rosbags`` does: first a mark of its start, so that chunks are read late."""
    yield chunk.message_start_time, 0, None, None
    file, at = _mcap_data(bag, chunk)
    end, found = at + chunk.uncompressed_size, []
    while at < end:
        file.seek(at)
        kind, size = _RECORD.unpack(file.read(_RECORD.size))
        at += _RECORD.size + size
        if at > end:
            raise DataError("a record of a chunk is longer than the chunk")
        if kind != _MESSAGE_KIND:
            continue
        channel, _, received_ns, _ = _MESSAGE.unpack(file.read(_MESSAGE.size))
        if channel in channels:
            size -= _MESSAGE.size
            size = min(size, HEAD_BYTES) if channels[channel].topic in cut else size
            found.append((received_ns, chunk.chunk_start_offset, channels[channel], file.read(size)))
    yield from sorted(found, key=lambda message: message[0])


def _mcap_data(bag: Any, chunk: Any) -> tuple[Any, int]:
    """Return a file that holds the data of a chunk of an MCAP file, and where in it they start."""
    from lz4.frame import LZ4FrameDecompressor
    from rosbags.rosbag2.storage_mcap import zstd  # type: ignore[attr-defined]  # Python's, or its backport

    start = chunk.chunk_start_offset + _RECORD.size + 40 + len(chunk.compression)
    if not chunk.compression:
        return bag, start
    kinds = {"lz4": LZ4FrameDecompressor, "zstd": zstd.ZstdDecompressor}
    if chunk.compression not in kinds:
        raise DataError(f"a chunk has the unknown compression {chunk.compression!r}")
    return ChunkStart(bag, start, chunk.compressed_size, kinds[chunk.compression]()), 0


def _ros1(reader: Any, connections: list[Any], cut: Collection[str]) -> Iterator[Message]:
    from rosbags.rosbag1.reader import Header, RecordType, read_bytes, read_uint32

    topics, current, file = {c.id: c.topic for c in connections}, -1, reader.bio
    for entry in merge(*(reader.indexes[c] for c in topics)):
        if entry.chunk_pos != current:
            current, (file, start) = entry.chunk_pos, _chunk_data(reader, entry.chunk_pos)
        file.seek(start + entry.offset)
        header = Header.read(file)
        while header.get_uint8("op") == RecordType.CONNECTION:
            file.seek(read_uint32(file), 1)
            header = Header.read(file)
        topic, size = topics[header.get_uint32("conn")], read_uint32(file)
        yield topic, entry.time, read_bytes(file, min(size, HEAD_BYTES) if topic in cut else size)


def _chunk_data(reader: Any, position: int) -> tuple[Any, int]:
    """Return a file that holds the data of a chunk of a ROS 1 bag, and where in it they start."""
    from bz2 import BZ2Decompressor

    from lz4.frame import LZ4FrameDecompressor
    from rosbags.rosbag1.reader import decompressors

    chunk = reader.chunks[position]
    if chunk.decompressor is decompressors["none"]:
        return reader.bio, chunk.datapos
    kind = BZ2Decompressor if chunk.decompressor is decompressors["bz2"] else LZ4FrameDecompressor
    return ChunkStart(reader.bio, chunk.datapos, chunk.datasize, kind()), 0
