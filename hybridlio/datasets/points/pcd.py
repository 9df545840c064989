"""Reader of PCL's ``.pcd`` files: text, binary and compressed.

Format: https://pointclouds.org/documentation/tutorials/pcd_file_format.html. Open3D aborts the process on a header with
two padding fields and allocates what a header announces; here every announced size is compared with the file's first.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hybridlio.core.errors import DataError
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.points.fields import (
    Columns,
    Field,
    binary_columns,
    blocked_columns,
    text_columns,
    truncated,
)

_TYPES = {"F": "f", "I": "i", "U": "u"}
_MAX_EXPANSION = 88  # LZF's longest reference, 3 bytes for 264
_HEAD_BYTES = 4096  # of a header, at least; usual ones have 200 to 400
_SAME_PLACE_M, _SAME_ROTATION = 1e-3, 1e-4  # of a viewpoint that states nothing; numbers rounded in text
_MAX_COUNT = 1 << 16  # values in a field; histograms of PCL have some hundreds


@dataclass(frozen=True)
class _Header:
    fields: tuple[Field, ...]
    points: int
    kind: bytes


def read_pcd(path: Path) -> Columns:
    """Read the columns of a ``.pcd`` file by name; padding and fields of several values are left out.

    Raises:
        DataError: the header is malformed, or the file ends before its last point.
    """
    header, data = _split(path.read_bytes())
    if header.kind == b"ascii":
        return text_columns(data, header.fields, header.points)
    if header.kind == b"binary":
        return binary_columns(data, header.fields, header.points)
    return blocked_columns(_decompressed(data, header), header.fields, header.points)


def note_viewpoints(paths: Sequence[Path], notes: Notes) -> None:
    """Note headers that state a pose of the sensor: programs differ in whether the points are moved by it already."""
    farthest_m, turned = 0.0, False
    for path in paths:
        try:
            with path.open("rb") as file:
                head = file.read(_HEAD_BYTES)
            stated = re.search(rb"^VIEWPOINT +(.+)$", head.split(b"\nDATA")[0], re.MULTILINE)
            numbers = np.array(stated[1].split() if stated else [], np.float64)
        except (OSError, ValueError):
            continue  # the error comes when the scan is read
        if numbers.shape == (7,) and np.isfinite(numbers).all():
            farthest_m = max(farthest_m, float(np.linalg.norm(numbers[:3])))
            turned |= bool(np.abs(numbers[4:]).max() > _SAME_ROTATION)
    if farthest_m > _SAME_PLACE_M or turned:
        notes.add(
            f"the headers state poses of the sensor (VIEWPOINT, up to {farthest_m:.1f} m from the origin"
            f"{', turned' if turned else ''}), which are not applied: points are taken to be in the lidar's frame. If "
            "they are in a map's frame, transform each scan by the inverse of its pose"
        )


def _split(content: bytes) -> tuple[_Header, bytes]:
    """Return the header and the data after it."""
    try:
        head, kind, data = re.split(rb"^DATA +(\w+)[ \t\r]*\n", content, maxsplit=1, flags=re.MULTILINE)
        rows = dict(line.split(maxsplit=1) for line in head.decode("ascii", "replace").splitlines() if " " in line)
        names, sizes, types = (rows[key].split() for key in ("FIELDS", "SIZE", "TYPE"))
        counts = [int(count) for count in rows.get("COUNT", "1 " * len(names)).split()]
        if kind not in (b"ascii", b"binary", b"binary_compressed") or not all(0 < c <= _MAX_COUNT for c in counts):
            raise ValueError(kind)
        fields = tuple(
            Field(name, np.dtype(f"<{_TYPES[letter]}{int(size)}"), count)
            for name, size, letter, count in zip(names, sizes, types, counts, strict=True)
        )
        points = int(rows["POINTS"]) if "POINTS" in rows else int(rows["WIDTH"]) * int(rows["HEIGHT"])
        if points < 0:
            raise ValueError(points)
    except (ValueError, KeyError, TypeError):
        raise DataError("cannot read the header; the file is truncated, or no .pcd file") from None
    return _Header(fields, points, kind), data


def _decompressed(data: bytes, header: _Header) -> bytes:
    """Return the data of a compressed file, whose sizes are checked before memory is taken."""
    size, whole = int.from_bytes(data[:4], "little"), int.from_bytes(data[4:8], "little")
    if len(data) < 8 + size:
        truncated(header.points)
    expected = header.points * sum(field.size for field in header.fields)
    if whole != expected or whole > _MAX_EXPANSION * size:
        raise DataError(f"announces {whole} bytes of points, but its {header.points} points take {expected}")
    if not whole:
        return b""
    import lzf

    try:
        found = lzf.decompress(data[8 : 8 + size], whole)
    except ValueError:
        found = None
    if found is None or len(found) != whole:
        raise DataError("the compressed data are damaged")
    return bytes(found)
