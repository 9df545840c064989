"""Headers of ``.pcd`` and ``.ply`` files, to detect truncated files.

Open3D does not detect them: it returns uninitialised memory as points.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from hybridlio.core.errors import DataError

_PLY_BYTES = {"char": 1, "short": 2, "int": 4, "float": 4, "double": 8} | {
    **{"uchar": 1, "ushort": 2, "uint": 4, "int8": 1, "uint8": 1, "int16": 2, "uint16": 2},
    **{"int32": 4, "uint32": 4, "float32": 4, "float64": 8},
}


@dataclass(frozen=True)
class Header:
    """The header of a point file, and its data.

    Attributes:
        points: number of points.
        fields: names of the columns.
        row_bytes: size of a point if the data are binary, else 0.
        data: the file's bytes after the header.
    """

    points: int
    fields: tuple[str, ...]
    row_bytes: int
    data: bytes


def read_header(path: Path) -> Header:
    """Read the header of a file, and check that the file holds all points that the header announces.

    Raises:
        DataError: the header is malformed, or the file ends before its last point; the message names the file.
    """
    content = path.read_bytes()
    try:
        header = _ply(content) if path.suffix == ".ply" else _pcd(content)
    except (ValueError, KeyError):
        raise DataError(f"{path}: cannot read the header; the file is truncated, or no {path.suffix} file") from None
    if header.row_bytes:
        whole = len(header.data) >= header.points * header.row_bytes
    else:
        lines = header.data.split(b"\n", header.points)[: header.points]
        whole = len(lines) == header.points and (not lines or len(lines[-1].split()) >= len(header.fields))
    if not whole:
        raise DataError(f"{path}: truncated, the file ends before the last of its {header.points} points")
    return header


def _ply(content: bytes) -> Header:
    header, data = re.split(rb"^end_header\r?\n", content, maxsplit=1, flags=re.MULTILINE)
    text = header.decode("ascii", "replace")
    vertices = re.search(r"^element vertex (\d+)\s+((?:(?:property|comment)[^\n]*\n)*)", text, re.MULTILINE)
    if vertices is None:
        raise ValueError("no vertices")
    properties = [line.split() for line in vertices[2].splitlines() if line.startswith("property")]
    row_bytes = 0 if "format ascii" in text else sum(_PLY_BYTES[kind] for _, kind, _ in properties)
    return Header(int(vertices[1]), tuple(name for _, _, name in properties), row_bytes, data)


def _pcd(content: bytes) -> Header:
    header, kind, data = re.split(rb"^DATA +(\w+)\s*?\n", content, maxsplit=1, flags=re.MULTILINE)
    rows = dict(line.split(maxsplit=1) for line in header.decode("ascii", "replace").splitlines() if " " in line)
    points, sizes = int(rows["POINTS"]), [int(size) for size in rows["SIZE"].split()]
    counts = [int(count) for count in rows.get("COUNT", "1 " * len(sizes)).split()]
    fields = tuple(name for name, count in zip(rows["FIELDS"].split(), counts, strict=True) for _ in range(count))
    if kind == b"binary_compressed":  # compressed and uncompressed size, 4 bytes each, then the compressed data
        return Header(1, fields, 8 + int.from_bytes(data[:4], "little"), data)
    row_bytes = sum(s * c for s, c in zip(sizes, counts, strict=True)) if kind == b"binary" else 0
    return Header(points, fields, row_bytes, data)
