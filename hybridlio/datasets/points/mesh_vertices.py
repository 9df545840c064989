"""Reader of scans as meshes: the vertices of ``.obj``, ``.off`` and ``.stl`` files.

A scan as a mesh has vertices and mostly no faces. Open3D reads none of these formats without faces. Formats:
https://paulbourke.net/dataformats/obj/, http://www.geomview.org/docs/html/OFF.html, https://www.fabbers.com/tech/STL_Format.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridlio.core.errors import DataError
from hybridlio.datasets.points.fields import Columns, truncated

SUFFIXES = (".obj", ".off", ".stl")  # of other things, too: scans only in a folder of scans

_OFF = re.compile(rb"(?:ST)?C?N?OFF")  # with texture coordinates, colours, normals, which follow the position
_STL_HEAD_BYTES = 84  # 80 of any text, then the number of triangles
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attributes", "<u2")])


def read_vertices(path: Path) -> Columns:
    """Read the coordinates of the vertices; corners that triangles of ``.stl`` files share are one vertex.

    Raises:
        DataError: the file has no vertices, is truncated, or a coordinate is no number.
    """
    read = {".obj": _read_obj, ".off": _read_off, ".stl": _read_stl}[path.suffix.lower()]
    points = read(path.read_bytes())
    if not len(points):
        raise DataError("holds no vertices")
    return dict(zip("xyz", points.T, strict=True))


def _read_obj(content: bytes) -> NDArray[Any]:
    return _numbers([line.split()[1:4] for line in content.splitlines() if line.split()[:1] == [b"v"]])


def _read_off(content: bytes) -> NDArray[Any]:
    lines = [words for line in content.splitlines() if (words := line.split(b"#")[0].split())]
    if not lines or not _OFF.fullmatch(lines[0][0]) or lines[0][1:2] == [b"BINARY"]:
        raise DataError("cannot read the header; no .off file of text")
    lines[0] = lines[0][1:]
    counts, *rows = lines if lines[0] else lines[1:] or [[]]
    try:
        vertices = int(counts[0])
    except (ValueError, IndexError):
        raise DataError("cannot read the number of vertices") from None
    if not 0 <= vertices <= len(rows):
        truncated(vertices)
    return _numbers([words[:3] for words in rows[:vertices]])


def _read_stl(content: bytes) -> NDArray[Any]:
    triangles = int.from_bytes(content[_STL_HEAD_BYTES - 4 : _STL_HEAD_BYTES], "little")
    if len(content) >= _STL_HEAD_BYTES and len(content) == _STL_HEAD_BYTES + triangles * _TRIANGLE.itemsize:
        corners = np.frombuffer(content, _TRIANGLE, offset=_STL_HEAD_BYTES)["corners"].reshape(-1, 3)
    elif content.lstrip().startswith(b"solid"):
        lines = [line.split() for line in content.splitlines()]
        corners = _numbers([words[1:] for words in lines if words[:1] == [b"vertex"]])
    else:
        truncated(3 * triangles)
    return np.unique(corners, axis=0)


def _numbers(rows: list[list[bytes]]) -> NDArray[Any]:
    try:
        return np.array(rows, dtype=np.bytes_).astype(np.float64).reshape(-1, 3)
    except ValueError as error:
        raise DataError(f"cannot read a vertex as three numbers ({str(error)[:120]})") from None
