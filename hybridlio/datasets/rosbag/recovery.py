"""Bags that have lost their index, as where the recorder was killed: the index is made again from the chunks.

Recorders write the index of a bag, and the summary of an MCAP file, when they close it. Until then the file holds whole
chunks, each followed by an index of its own messages, and perhaps a part of one more. The chunks' headers are passed
over, and the library ``rosbags`` is given the file up to the end of its last whole chunk with a new index behind it.
Nothing is written.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any, BinaryIO

from hybridlio.core.errors import DataError
from hybridlio.core.tables import counted
from hybridlio.datasets.rosbag.recovery_mcap import mcap_index
from hybridlio.datasets.rosbag.recovery_ros1 import ros1_index

_INDEXERS = {".bag": ros1_index, ".mcap": mcap_index}


class RecoveredFile:
    """A file with another start and a new index at its end, for ``rosbags`` in place of its path.

    Args:
        path: the file.

    Raises:
        DataError: it holds no whole chunk, or is of another format.
    """

    def __init__(self, path: Path) -> None:
        if path.suffix not in _INDEXERS:
            raise DataError("no index can be made for files of this kind")
        self.path, self.size = path, path.stat().st_size
        with path.open("rb") as file:
            self.start, self.end, self.index, chunks = _INDEXERS[path.suffix](file, self.size)
        lost = self.size - self.end
        behind = f", and {lost / 1e6:.1f} MB behind the last whole one are lost" if lost else ""
        self.note = (
            f"{path.name}: the index is missing or damaged, as where the recorder was killed; it was made again from "
            f"{counted(chunks, 'chunk')}{behind}"
        )

    def open(self, *_: Any) -> BinaryIO:
        """Open the file with its index for reading."""
        return io.BufferedReader(_Spliced(self))

    def __getattr__(self, name: str) -> Any:
        return getattr(self.path, name)


class _Spliced(io.RawIOBase):
    """The bytes of a recovered file."""

    def __init__(self, parts: RecoveredFile) -> None:
        self._parts, self._at = parts, 0
        self._size = parts.end + len(parts.index)
        self._file = parts.path.open("rb")

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        base = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._size}[whence]
        self._at = max(base + offset, 0)
        return self._at

    def tell(self) -> int:
        return self._at

    def readinto(self, buffer: Any, /) -> int:
        data = self._next(len(buffer))
        buffer[: len(data)] = data
        self._at += len(data)
        return len(data)

    def _next(self, count: int) -> bytes:
        """Return some of the next bytes, all of one part; none at the end."""
        start, end, index = self._parts.start, self._parts.end, self._parts.index
        if self._at < len(start):
            return start[self._at : self._at + count]
        if self._at < end:
            self._file.seek(self._at)
            return self._file.read(min(count, end - self._at))
        return index[self._at - end : self._at - end + count]

    def close(self) -> None:
        self._file.close()
        super().close()
