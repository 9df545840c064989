"""Reader of ``.ply`` files: the vertices, as text or binary of either byte order.

Format: http://paulbourke.net/dataformats/ply/. Open3D drops columns of types that it lacks, such as unsigned times.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from hybridlio.core.errors import DataError
from hybridlio.datasets.points.fields import Columns, Field, binary_columns, text_columns

_TYPES = {
    **{"char": "i1", "short": "i2", "int": "i4", "float": "f4", "double": "f8"},
    **{"uchar": "u1", "ushort": "u2", "uint": "u4", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2"},
    **{"int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8"},
}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}


def read_ply(path: Path) -> Columns:
    """Read the columns of the vertices by name; other elements are left out.

    Raises:
        DataError: the header is malformed, vertices are not the first element, or the file ends before the last one.
    """
    content = path.read_bytes()
    try:
        head, data = re.split(rb"^end_header\r?\n", content, maxsplit=1, flags=re.MULTILINE)
        lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
        form = next(line[1] for line in lines if line[:1] == ["format"])
        element = next(k for k, line in enumerate(lines) if line[:1] == ["element"])
        _, name, count = lines[element]
        points = int(count)
        if name != "vertex" or points < 0 or form not in ("ascii", *_ORDERS):
            raise ValueError(name)
        fields = tuple(_fields(lines[element + 1 :], _ORDERS.get(form, "<")))
    except (ValueError, KeyError, StopIteration, IndexError):
        raise DataError("cannot read the header; the file is truncated, or no .ply file of vertices") from None
    read = text_columns if form == "ascii" else binary_columns
    return read(data, fields, points)


def _fields(lines: list[list[str]], order: str) -> list[Field]:
    fields = []
    for line in lines:
        if line[:1] == ["element"]:
            break
        if line[:1] == ["property"]:
            _, kind, name = line  # a list has more words
            fields.append(Field(name, np.dtype(order + _TYPES[kind])))
    return fields
