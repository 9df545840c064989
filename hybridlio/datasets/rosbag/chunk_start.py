"""The start of a compressed chunk of a bag, decompressed no farther than it is read."""

from __future__ import annotations

import os
from typing import Any, BinaryIO

_PIECE_BYTES = 1 << 16  # of compressed data read at a time: a block of LZ4 as `rosbags` writes it; ROS writes 1 MB


class ChunkStart:
    """A file in memory over the data of a chunk, with the methods by which ``rosbags`` reads records."""

    def __init__(self, file: BinaryIO, position: int, size: int, decompressor: Any) -> None:
        """Take the ``size`` compressed bytes at ``position`` of a file; nothing is read.

        Args:
            file: of the bag.
            position, size: of the chunk's data.
            decompressor: an object of ``bz2.BZ2Decompressor``, or one with its methods.
        """
        self._file, self._from, self._left = file, position, size
        self._decompressor, self._data, self._at = decompressor, bytearray(), 0

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move to a position in the decompressed data."""
        self._at = offset if whence == os.SEEK_SET else self._at + offset
        return self._at

    def read(self, size: int) -> bytes:
        """Return the next ``size`` decompressed bytes; fewer at the end of the chunk."""
        self._decompress(self._at + size)
        found = bytes(self._data[self._at : self._at + size])
        self._at += len(found)
        return found

    def _decompress(self, end: int) -> None:
        while len(self._data) < end and not self._decompressor.eof:
            piece = b""
            if self._decompressor.needs_input:
                self._file.seek(self._from)
                piece = self._file.read(min(_PIECE_BYTES, self._left))
                if not piece:
                    return
                self._from, self._left = self._from + len(piece), self._left - len(piece)
            self._data += self._decompressor.decompress(piece, end - len(self._data))
