"""Files of maps, read back by other programs' readers: the same points, times, normals and colours."""

import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hybridlio.core.errors import ConfigError
from hybridlio.core.geodesy import GeodeticPoint
from hybridlio.core.setting_checks import SettingError
from hybridlio.datasets.points.pcd import read_pcd
from hybridlio.datasets.points.ply import read_ply
from hybridlio.mapping.colours import COLOURS, colours_by
from hybridlio.mapping.files import FORMATS, check_map_path, write_map
from hybridlio.mapping.map_projection import projected, utm_crs
from hybridlio.mapping.mesh import FORMATS as MESH_FORMATS
from hybridlio.mapping.mesh import write_mesh
from hybridlio.mapping.point_map import PointMap
from hybridlio.mapping.settings import MapSettings

FAR = np.array([431_234.5, -52_111.25, 120.0])  # as far as projected coordinates are from zero


def cloud(offset: np.ndarray | float = 0.0, intensity: bool = True) -> PointMap:
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(2000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return PointMap(
        5 * directions + offset,
        rng.random(2000).astype(np.float32) if intensity else None,
        directions.astype(np.float32),
        np.zeros(2000, np.float32),
        rng.uniform(0, 60, 2000).astype(np.float32),
        rng.integers(1, 9, 2000).astype(np.uint16),
    )


def test_ply_keeps_float64_coordinates_and_all_columns(tmp_path: Path) -> None:
    points = cloud(FAR)
    write_map(tmp_path / "map.ply", points, "height")
    read = read_ply(tmp_path / "map.ply")
    np.testing.assert_array_equal(np.column_stack([read[axis] for axis in "xyz"]), points.points)
    np.testing.assert_array_equal(read["nz"], points.normals[:, 2])  # type: ignore[index]
    np.testing.assert_array_equal(read["last_s"], points.last_s)
    assert read["red"].dtype == np.uint8


def test_open3d_reads_points_normals_and_colours(tmp_path: Path) -> None:
    o3d = pytest.importorskip("open3d")
    points = cloud()
    for suffix in (".ply", ".pcd"):
        write_map(tmp_path / f"map{suffix}", points, "height")
        read = o3d.io.read_point_cloud(str(tmp_path / f"map{suffix}"))
        np.testing.assert_allclose(np.asarray(read.points), points.points, atol=1e-6)
        np.testing.assert_allclose(np.asarray(read.normals), points.normals, atol=1e-6)
        np.testing.assert_allclose(255 * np.asarray(read.colors), colours_by(points, "height"), atol=0.51)


def test_pcd_has_every_column(tmp_path: Path) -> None:
    points = cloud()
    write_map(tmp_path / "map.pcd", points, "time")
    read = read_pcd(tmp_path / "map.pcd")
    np.testing.assert_allclose(read["normal_x"], points.normals[:, 0])  # type: ignore[index]
    np.testing.assert_array_equal(read["scans"], points.scans)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_las_has_points_to_a_millimetre_times_colours_and_the_crs(tmp_path: Path, suffix: str) -> None:
    laspy = pytest.importorskip("laspy")
    origin = GeodeticPoint(49.01, 8.42, 115.0)
    points = projected(cloud(), origin)
    write_map(tmp_path / f"map{suffix}", points, "intensity", utm_crs(origin))
    read = laspy.read(tmp_path / f"map{suffix}")
    np.testing.assert_allclose(read.xyz, points.points, atol=0.00051)
    np.testing.assert_allclose(read.gps_time, points.last_s)
    np.testing.assert_allclose(read.normal_y, points.normals[:, 1])  # type: ignore[index]
    np.testing.assert_allclose(np.asarray(read.intensity) / 65535, points.intensity, atol=1e-5)
    assert read.header.parse_crs().to_epsg() == 32632
    assert int(np.max(read.red)) == 65535


def test_npz_has_the_arrays(tmp_path: Path) -> None:
    points = cloud()
    write_map(tmp_path / "map.npz", points, "none")
    with np.load(tmp_path / "map.npz", allow_pickle=False) as read:
        assert set(read.files) == {"points", "intensity", "normals", "first_s", "last_s", "scans"}
        np.testing.assert_array_equal(read["points"], points.points)


@pytest.mark.parametrize("suffix", FORMATS)
def test_an_empty_map_can_be_written(tmp_path: Path, suffix: str) -> None:
    empty = PointMap(
        np.empty((0, 3)), *[np.empty(0, np.float32)] * 1, None, *[np.empty(0, np.float32)] * 2, np.empty(0, np.uint16)
    )
    write_map(tmp_path / f"map{suffix}", empty, "none")
    assert (tmp_path / f"map{suffix}").stat().st_size > 0


def test_utm_agrees_with_distances_on_the_ground() -> None:
    origin = GeodeticPoint(49.01, 8.42, 115.0)
    east_100 = PointMap(
        np.array([[0.0, 0, 0], [100.0, 0, 0]]), None, None, *[np.zeros(2, np.float32)] * 2, np.ones(2, np.uint16)
    )
    at = projected(east_100, origin).points
    # the scale of UTM is 0.9996 at the central meridian, 9° E, and 0.0000198 more 42 km west of it; ellipsoid to 115 m
    # height 0.999982
    assert np.linalg.norm(at[1, :2] - at[0, :2]) == pytest.approx(100 * 0.9996 * 1.00002 * 0.999982, abs=1e-3)
    assert at[0, 2] == pytest.approx(115.0, abs=1e-6)


def test_colours_follow_the_value_and_ignore_stray_points() -> None:
    points = cloud()
    stray = PointMap(**{**vars(points), "points": np.vstack([points.points[:-1], [[0, 0, 1e4]]])})
    np.testing.assert_allclose(
        colours_by(points, "height")[:-1].astype(int),
        colours_by(stray, "height")[:-1].astype(int),
        atol=12,  # type: ignore[index]
    )
    grey = colours_by(points, "intensity")
    assert grey is not None
    assert np.corrcoef(grey[:, 0], points.intensity)[0, 1] > 0.99  # type: ignore[arg-type]
    assert colours_by(points, "none") is None
    assert set(COLOURS) == {"height", "intensity", "time", "none"}


@pytest.mark.parametrize("suffix", MESH_FORMATS)
def test_a_mesh_of_a_sphere_is_the_sphere(suffix: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    o3d = pytest.importorskip("open3d")
    half = replace(cloud(), intensity=(cloud().points[:, 2] > 0).astype(np.float32))
    triangles = write_mesh(tmp_path / f"mesh{suffix}", half, 0.2, "intensity")
    assert triangles > 500
    assert capfd.readouterr().out == "", "Open3D warns on stdout of colours that it extrapolates, and of normals"
    mesh = o3d.io.read_triangle_mesh(str(tmp_path / f"mesh{suffix}"))
    assert len(mesh.triangles) == triangles
    assert mesh.has_vertex_colors() == (suffix != ".stl")
    np.testing.assert_allclose(np.linalg.norm(np.asarray(mesh.vertices), axis=1), 5.0, atol=0.1)


def test_a_binary_mesh_has_its_numbers_in_a_binary_chunk(tmp_path: Path) -> None:
    pytest.importorskip("open3d")
    write_mesh(tmp_path / "mesh.glb", cloud(), 0.5)
    content = (tmp_path / "mesh.glb").read_bytes()
    magic, version, length, size, kind = struct.unpack_from("<4sIII4s", content)
    assert (magic, version, length, kind) == (b"glTF", 2, len(content), b"JSON")
    scene = json.loads(content[20 : 20 + size])
    size_binary, kind = struct.unpack_from("<I4s", content, 20 + size)
    assert (kind, 28 + size + size_binary) == (b"BIN\0", len(content))
    assert "uri" not in scene["buffers"][0]
    assert 0 <= size_binary - scene["buffers"][0]["byteLength"] < 4


def test_what_cannot_work_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"unknown format; use one of \.ply"):
        check_map_path(tmp_path / "map.xyz")
    with pytest.raises(ConfigError, match="no intensity"):
        write_map(tmp_path / "map.ply", cloud(intensity=False), "intensity")
    with pytest.raises(ConfigError, match="unknown colour 'red'"):
        write_map(tmp_path / "map.ply", cloud(), "red")
    with pytest.raises(ConfigError, match="needs normals"):
        write_mesh(tmp_path / "mesh.ply", PointMap(**{**vars(cloud()), "normals": None}), 0.1)
    with pytest.raises(SettingError, match="max_range_m"):
        MapSettings(min_range_m=5, max_range_m=4)
    with pytest.raises(SettingError, match="voxel_m"):
        MapSettings(voxel_m=0)
    assert not list(tmp_path.iterdir()), json.dumps([str(p) for p in tmp_path.iterdir()])
