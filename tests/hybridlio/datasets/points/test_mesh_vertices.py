"""Scans as meshes: vertices with and without faces, as text and binary."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hybridlio.core.errors import DataError
from hybridlio.datasets import open_sequence
from hybridlio.datasets.points.mesh_vertices import read_vertices

POINTS = np.round(np.random.default_rng(0).uniform(-9, 9, (21, 3)), 3)
ROWS = [f"{x} {y} {z}" for x, y, z in POINTS]
FILES = {
    "obj": ("# made here\no scan\n" + "".join(f"v {row}\n" for row in ROWS)),
    "obj with colours and faces": "".join(f"v {row} 0.1 0.2 0.3\nvn 0 0 1\n" for row in ROWS) + "f 1 2 3\n",
    "off": f"OFF\n{len(ROWS)} 0 0\n" + "\n".join(ROWS),
    "off with counts beside it, comments and faces": f"OFF {len(ROWS)} 1 0\n# made here\n\n"
    + "\n".join(f"{row} # a point" for row in ROWS)
    + "\n3 0 1 2\n",
    "off with colours": f"COFF\n{len(ROWS)} 0 0\n" + "\n".join(f"{row} 255 0 0 255" for row in ROWS),
    "stl": "solid scan\n"
    + "".join(
        "facet normal 0 0 1\nouter loop\n"
        + "".join(f"vertex {row}\n" for row in ROWS[k : k + 3])
        + "endloop\nendfacet\n"
        for k in range(0, len(ROWS), 3)
    )
    + "endsolid scan\n",
}


def read(folder: Path, name: str, content: bytes) -> np.ndarray:
    path = folder / f"scan.{name.split()[0]}"
    path.write_bytes(content)
    return np.column_stack(list(read_vertices(path).values()))


@pytest.mark.parametrize("name", FILES)
def test_the_vertices_are_the_points(tmp_path: Path, name: str) -> None:
    found = read(tmp_path, name, FILES[name].encode())
    np.testing.assert_array_equal(np.unique(found, axis=0), np.unique(POINTS, axis=0))


def test_files_that_open3d_writes_are_read(tmp_path: Path) -> None:
    import open3d as o3d

    box = o3d.geometry.TriangleMesh.create_sphere(2.0)
    box.compute_vertex_normals()
    for suffix in ("obj", "off", "stl"):
        path = tmp_path / f"sphere.{suffix}"
        o3d.io.write_triangle_mesh(str(path), box)
        found = np.column_stack(list(read_vertices(path).values()))
        assert len(found) == len(box.vertices)
        np.testing.assert_allclose(np.linalg.norm(found, axis=1), 2.0, atol=1e-5)


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("obj", b"", "holds no vertices"),
        ("obj", b"v 1 2\n", "as three numbers"),
        ("obj", b"v 1 2 x\n", "as three numbers"),
        ("off", b"1 2 3\n", "no .off file"),
        ("off", b"OFF BINARY\n\0\0", "no .off file"),
        ("off", b"OFF\n", "number of vertices"),
        ("off", b"OFF\n4 0 0\n1 2 3\n", "before the last of its 4 points"),
        ("stl", b"\0" * 80 + b"\x02\0\0\0" + b"\0" * 50, "before the last of its 6 points"),
    ],
)
def test_a_malformed_mesh_is_one_clear_error(tmp_path: Path, name: str, content: bytes, says: str) -> None:
    with pytest.raises(DataError, match=says):
        read(tmp_path, name, content)


def test_meshes_are_scans_in_a_folder_of_scans_only(tmp_path: Path) -> None:
    (tmp_path / "scans").mkdir()
    (tmp_path / "robot.stl").write_text(FILES["stl"])
    for k in range(3):
        (tmp_path / "scans" / f"{k}.obj").write_text(FILES["obj"])
    assert len(open_sequence(tmp_path, rate_hz=10)) == 3
    for file in (tmp_path / "scans").glob("*"):
        file.unlink()
    with pytest.raises(DataError):
        open_sequence(tmp_path, rate_hz=10)
