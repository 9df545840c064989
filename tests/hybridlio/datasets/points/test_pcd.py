"""PCD files with padding, of every type, compressed, and with sizes that are not true."""

from __future__ import annotations

from pathlib import Path

import lzf
import numpy as np
import pytest

from hybridlio.core.errors import DataError
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.points.pcd import note_viewpoints, read_pcd
from hybridlio.datasets.points.point_files import read_scan

COUNT = 50
XYZ = np.random.default_rng(0).uniform(-9, 9, (COUNT, 3)).astype("<f4")


def header(fields: list[tuple[str, str, int]], kind: str, points: int = COUNT) -> bytes:
    names, types, counts = zip(*fields, strict=True)
    sizes = [np.dtype(t).itemsize for t in types]
    letters = [{"f": "F", "i": "I", "u": "U"}[np.dtype(t).kind] for t in types]
    rows = {"FIELDS": names, "SIZE": sizes, "TYPE": letters, "COUNT": counts, "WIDTH": [points], "HEIGHT": [1]}
    text = "# .PCD v0.7\nVERSION 0.7\n" + "".join(f"{key} {' '.join(map(str, row))}\n" for key, row in rows.items())
    return f"{text}VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA {kind}\n".encode()


def rows(fields: list[tuple[str, str, int]]) -> np.ndarray:
    out = np.zeros(COUNT, [(str(k), dtype, (count,)) for k, (_, dtype, count) in enumerate(fields)])
    names = [name for name, _, _ in fields]
    for k, axis in enumerate("xyz"):
        out[str(names.index(axis))][:, 0] = XYZ[:, k]
    return out


PADDINGS = [
    [("x", "<f4", 1), ("y", "<f4", 1), ("z", "<f4", 1), ("_", "|u1", 4), ("i", "<f4", 1), ("_", "|u1", 12)],
    [("_", "|u1", 3), ("x", "<f8", 1), ("_", "|i1", 1), ("y", "<f8", 1), ("_", "<u8", 2), ("z", "<f8", 1)],
    [("x", "<f4", 1), ("y", "<f4", 1), ("z", "<f4", 1), ("fpfh", "<f4", 33), ("x", "<f4", 1)],
]


@pytest.mark.parametrize("fields", PADDINGS, ids=["two paddings", "padding first", "histogram and repeated name"])
@pytest.mark.parametrize("kind", ["ascii", "binary", "binary_compressed"])
def test_padding_and_fields_of_several_values_are_passed_over(tmp_path: Path, fields: list, kind: str) -> None:
    table = rows(fields)
    if kind == "ascii":
        data = "\n".join(" ".join(str(v) for part in row for v in np.ravel(part)) for row in table).encode()
    elif kind == "binary":
        data = table.tobytes()
    else:
        whole = b"".join(np.ascontiguousarray(table[name]).tobytes() for name in table.dtype.names)
        packed = lzf.compress(whole)
        data = len(packed).to_bytes(4, "little") + len(whole).to_bytes(4, "little") + packed
    (tmp_path / "scan.pcd").write_bytes(header(fields, kind) + data)
    columns = read_pcd(tmp_path / "scan.pcd")
    np.testing.assert_allclose(np.column_stack([columns[axis] for axis in "xyz"]), XYZ, rtol=1e-6)
    assert set(columns) <= {"x", "y", "z", "i"}


def test_the_known_file_with_two_padding_fields_is_read(cases: Path) -> None:
    scan = read_scan(cases / "pcd_two_padding_fields.pcd", 0)
    assert scan.points.shape == (2000, 3)
    assert np.abs(scan.points).max() < 20
    assert 0 < scan.intensity.max() <= 1


@pytest.mark.parametrize("kind", ["ascii", "binary", "binary_compressed"])
@pytest.mark.parametrize("points", [10**12, 2**63, COUNT + 1])
def test_an_announced_size_that_the_file_does_not_hold_is_refused(tmp_path: Path, kind: str, points: int) -> None:
    fields = [(axis, "<f4", 1) for axis in "xyz"]
    packed = b"\x00" * 100
    data = (
        len(packed).to_bytes(4, "little") + (2**32 - 1).to_bytes(4, "little") + packed
        if kind == "binary_compressed"
        else XYZ.tobytes()
    )
    (tmp_path / "scan.pcd").write_bytes(header(fields, kind, points) + data)
    with pytest.raises(DataError, match=r"truncated|announces"):
        read_pcd(tmp_path / "scan.pcd")


def test_damaged_compressed_data_are_refused(tmp_path: Path) -> None:
    fields = [(axis, "<f4", 1) for axis in "xyz"]
    packed = lzf.compress(np.repeat(XYZ.T[0], 3).tobytes())
    whole = COUNT * 12
    rng = np.random.default_rng(1)
    for _ in range(200):
        damaged = bytearray(packed or XYZ.tobytes())
        damaged[rng.integers(len(damaged))] ^= int(rng.integers(1, 256))
        data = len(damaged).to_bytes(4, "little") + whole.to_bytes(4, "little") + bytes(damaged)
        (tmp_path / "scan.pcd").write_bytes(header(fields, "binary_compressed") + data)
        try:
            columns = read_pcd(tmp_path / "scan.pcd")
        except DataError:
            continue
        assert len(columns["x"]) == COUNT


@pytest.mark.parametrize(
    "change",
    [
        (b"SIZE 4 4 4", b"SIZE 4 4"),
        (b"SIZE 4 4 4", b"SIZE 4 4 3"),
        (b"TYPE F F F", b"TYPE F F Q"),
        (b"COUNT 1 1 1", b"COUNT 1 1 -1"),
        (b"COUNT 1 1 1", b"COUNT 1 1 99999999"),
        (b"POINTS 50", b"POINTS -1"),
        (b"POINTS 50", b"POINTS many"),
        (b"DATA binary", b"DATA zip"),
        (b"FIELDS x y z", b"x y z"),
    ],
)
def test_a_malformed_header_is_refused(tmp_path: Path, change: tuple[bytes, bytes]) -> None:
    content = header([(axis, "<f4", 1) for axis in "xyz"], "binary") + XYZ.tobytes()
    assert change[0] in content
    (tmp_path / "scan.pcd").write_bytes(content.replace(*change))
    with pytest.raises(DataError, match="cannot read the header"):
        read_pcd(tmp_path / "scan.pcd")


@pytest.mark.parametrize(
    ("viewpoint", "says"),
    [
        ("0 0 0 1 0 0 0", ""),
        ("0.0 0.0 0.0 1.0 0.0 0.0 0.0", ""),
        ("4 0 3 1 0 0 0", "up to 5.0 m from the origin)"),
        ("0 0 0 0.7 0 0 0.7", "up to 0.0 m from the origin, turned)"),
    ],
)
def test_a_stated_pose_of_the_sensor_is_not_applied_and_said(tmp_path: Path, viewpoint: str, says: str) -> None:
    head = header([(axis, "<f4", 1) for axis in "xyz"], "binary").replace(b"0 0 0 1 0 0 0", viewpoint.encode())
    (tmp_path / "scan.pcd").write_bytes(head + XYZ.tobytes())
    notes = Notes("ride")
    note_viewpoints([tmp_path / "scan.pcd"], notes)
    assert [says in note for note in notes.texts] == [True] * bool(says)
    np.testing.assert_array_equal(read_scan(tmp_path / "scan.pcd", 0).points, XYZ)
