"""Damaged scan files of every kind: a scan, or one error that names the file."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest

from hybridlio.core.errors import DataError
from hybridlio.datasets.points.point_files import read_scan

COUNT = 60
MUTATIONS = 400  # of each kind
KINDS = {"<f4": ("F", "float"), "<u4": ("U", "uint")}


def rows() -> np.ndarray:
    out = np.zeros(COUNT, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("t", "<u4")])
    for k, axis in enumerate("xyz"):
        out[axis] = np.random.default_rng(k).uniform(-30, 30, COUNT)
    out["intensity"], out["t"] = np.arange(COUNT), np.linspace(0, 99_000_000, COUNT)
    return out


def write(path: Path) -> None:
    table = rows()
    kinds = {name: KINDS[table.dtype[name].str] for name in table.dtype.names}
    if path.suffix == ".npy":
        np.save(path, table)
    elif path.suffix == ".xyz":
        np.savetxt(path, np.column_stack([table[name] for name in table.dtype.names]), header="x y z intensity t")
    elif path.suffix == ".obj":
        path.write_text("".join(f"v {x} {y} {z}\n" for x, y, z in table[["x", "y", "z"]].tolist()))
    elif path.suffix == ".off":
        path.write_text(
            f"OFF\n{COUNT} 0 0\n" + "".join(f"{x} {y} {z}\n" for x, y, z in table[["x", "y", "z"]].tolist())
        )
    elif path.suffix == ".stl":
        triangles = np.zeros(COUNT // 3, [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attributes", "<u2")])
        triangles["corners"] = np.column_stack([table[axis] for axis in "xyz"]).reshape(-1, 3, 3)
        path.write_bytes(bytes(80) + len(triangles).to_bytes(4, "little") + triangles.tobytes())
    elif path.suffix == ".bin":
        np.column_stack([table[name] for name in table.dtype.names[:4]]).astype("<f4").tofile(path)
    elif path.suffix == ".pcd":
        lines = {"FIELDS": kinds, "SIZE": "44444", "TYPE": [letter for letter, _ in kinds.values()], "COUNT": "11111"}
        head = "".join(f"{key} {' '.join(values)}\n" for key, values in lines.items())
        path.write_bytes(f"{head}WIDTH {COUNT}\nHEIGHT 1\nPOINTS {COUNT}\nDATA binary\n".encode() + table.tobytes())
    elif path.suffix == ".ply":
        head = "".join(f"property {kind} {name}\n" for name, (_, kind) in kinds.items())
        start = f"ply\nformat binary_little_endian 1.0\nelement vertex {COUNT}\n{head}end_header\n"
        path.write_bytes(start.encode() + table.tobytes())
    elif path.suffix == ".feather":
        pa = pytest.importorskip("pyarrow")
        from pyarrow import feather

        feather.write_feather(pa.table({name: table[name] for name in table.dtype.names}), path)
    else:
        laspy = pytest.importorskip("laspy")
        las = laspy.LasData(laspy.LasHeader(point_format=1, version="1.2"))
        las.x, las.y, las.z = (table[axis] for axis in "xyz")
        las.write(path)


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """Return the data cut off, with some bytes of the header or of the whole changed, or with a part repeated."""
    out, kind = bytearray(data), rng.integers(4)
    if kind == 0:
        return bytes(out[: rng.integers(len(out))])
    if kind == 3:
        at, start = rng.integers(len(out), size=2)
        out[at:at] = out[start : start + rng.integers(1, 50)]
        return bytes(out)
    for _ in range(rng.integers(1, 8)):
        out[rng.integers(min(len(out), 500) if kind == 1 else len(out))] = rng.integers(256)
    return bytes(out)


@pytest.mark.parametrize(
    "suffix", [".npy", ".bin", ".pcd", ".ply", ".las", ".laz", ".feather", ".xyz", ".obj", ".off", ".stl"]
)
def test_a_damaged_file_gives_a_scan_or_one_error_that_names_it(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"scan{suffix}"
    write(path)
    data, rng = path.read_bytes(), np.random.default_rng(7)
    assert len(read_scan(path, 0)) == COUNT
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(MUTATIONS):
            path.write_bytes(mutated(data, rng))
            try:
                scan = read_scan(path, 0)
            except DataError as error:
                named = str(error)
            else:
                named = str(path.parent) if np.isfinite(scan.points).all() else ""
            assert str(path.parent) in named
