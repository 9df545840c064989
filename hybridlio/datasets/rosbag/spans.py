"""When the first and the last message of a topic were received, from the index of a bag, without reading messages."""

from __future__ import annotations

import struct
from typing import Any

from hybridlio.datasets.rosbag.heads import is_part

_INDEX = struct.Struct("<BQHI")  # MCAP, https://mcap.dev/spec: kind and length of a record, channel, bytes of entries
_ENTRY = struct.Struct("<QQ")  # time of receipt, offset in the chunk
_INDEX_KIND = 7

Span = tuple[int, int]  # ns


def span_of(connections: list[Any]) -> Span | None:
    """Return the first and the last time of receipt, ns, of a topic's connections; None where no index tells them."""
    found = [_of_connection(one) for one in connections if one.msgcount]
    known = [span for span in found if span is not None]
    return (min(s for s, _ in known), max(e for _, e in known)) if known and len(known) == len(found) else None


def _of_connection(connection: Any) -> Span | None:
    from rosbags.rosbag1 import Reader
    from rosbags.rosbag2.reader import DirectoryReader
    from rosbags.rosbag2.storage_mcap import McapReader
    from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

    owner = connection.owner
    if isinstance(owner, Reader):
        times = [entry.time for entry in owner.indexes[connection.id]]
        return min(times), max(times)
    if isinstance(owner, DirectoryReader):
        return span_of([c for storage in owner.storages for c in storage.connections if is_part(c, connection)])
    if isinstance(owner, Sqlite3Reader):
        return _sqlite(owner, connection.id)
    return _mcap(owner, connection.id) if isinstance(owner, McapReader) else None


def _sqlite(storage: Any, topic: int) -> Span | None:
    """Return the ends by the table's index of times, which is followed as far as the topic's first message."""
    query = "SELECT timestamp FROM messages WHERE topic_id = ? ORDER BY timestamp {} LIMIT 1"
    ends = [storage.dbconn.execute(query.format(order), (topic,)).fetchone() for order in ("ASC", "DESC")]
    return (ends[0][0], ends[1][0]) if all(ends) else None


def _mcap(storage: Any, channel: int) -> Span | None:
    """Return the ends by the indexes of the first and the last chunk that hold the channel."""
    chunks = [chunk for chunk in storage.chunks if chunk.channel_count.get(channel)]
    if not chunks:
        return None
    first = min(chunks, key=lambda chunk: chunk.message_start_time)
    last = max(chunks, key=lambda chunk: chunk.message_end_time)
    return min(_mcap_times(storage.bio, first, channel)), max(_mcap_times(storage.bio, last, channel))


def _mcap_times(file: Any, chunk: Any, channel: int) -> list[int]:
    """Return the times of a channel's messages in a chunk; the chunk's own where its index does not tell them."""
    file.seek(chunk.message_index_offsets[channel])
    kind, _, found, size = _INDEX.unpack(file.read(_INDEX.size))
    times = [time for time, _ in _ENTRY.iter_unpack(file.read(size - size % _ENTRY.size))]
    whole = [chunk.message_start_time, chunk.message_end_time]
    return times if kind == _INDEX_KIND and found == channel and times else whole
