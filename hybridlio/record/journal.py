"""A file that grows by whole blocks. A block that was cut off, by a kill or a full disk, is not read.

Each block has a header with its length and checksum. Small blocks are compressed, which is slower than writing for
large ones.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from hybridlio.core.errors import DataError

_MAGIC, _MAGIC_PACKED = b"hlj1", b"hlz1"
_HEADER = struct.Struct("<4sQI")  # magic, length, CRC-32 of both and of the content
_LARGEST_PACKED = 1 << 20  # compressed in 20 ms; a block of 50 scans has a third of that, a state ten times as much
_LARGEST_UNPACKED = 1 << 28  # of a compressed block that is read; the rest of a larger one is damage


def append_block(file: IO[bytes], content: bytes) -> None:
    """Append a block, and wait until it is on the disk.

    Raises:
        OSError: the disk is full, for instance.
    """
    magic = _MAGIC
    if len(content) <= _LARGEST_PACKED:
        magic, content = _MAGIC_PACKED, zlib.compress(content, 1)
    file.write(_HEADER.pack(magic, len(content), _checksum(magic, content)))
    file.write(content)
    file.flush()
    os.fdatasync(file.fileno())


def blocks(path: Path) -> Iterator[tuple[int, bytes]]:
    """Yield the content of every whole block, with the file's length up to its end.

    Raises:
        DataError: the file cannot be read.
    """
    try:
        with path.open("rb") as file:
            left = os.fstat(file.fileno()).st_size
            while (content := _next(file, left)) is not None:
                left = os.fstat(file.fileno()).st_size - file.tell()
                yield file.tell(), content
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from error


def _next(file: IO[bytes], left: int) -> bytes | None:
    """Return the next block's content; None at the end, and where the rest is no whole block."""
    header = file.read(_HEADER.size)
    if len(header) < _HEADER.size:
        return None
    magic, length, checksum = _HEADER.unpack(header)
    if magic not in (_MAGIC, _MAGIC_PACKED) or length > left:
        return None
    content = file.read(length)
    if len(content) != length or _checksum(magic, content) != checksum:
        return None
    if magic == _MAGIC:
        return content
    unpacker = zlib.decompressobj()
    content = unpacker.decompress(content, _LARGEST_UNPACKED)
    return content if unpacker.eof else None


def _checksum(magic: bytes, content: bytes) -> int:
    return zlib.crc32(content, zlib.crc32(magic + len(content).to_bytes(8, "little")))
