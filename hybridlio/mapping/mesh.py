"""Meshes of small maps: Poisson surface reconstruction by Open3D (Kazhdan and Hoppe, ACM TOG 2013)."""

from __future__ import annotations

import base64
import json
import math
import struct
from pathlib import Path

import numpy as np

from hybridlio.core.errors import ConfigError, DataError
from hybridlio.core.files import atomic_path
from hybridlio.mapping.colours import colours_by
from hybridlio.mapping.point_map import PointMap

MAX_POINTS = 5_000_000  # Poisson reconstruction takes about 1 GiB for each million
_MAX_DEPTH = 12  # of the octree; each level more takes four times the memory
_UNSUPPORTED = 0.05  # share of the vertices, those with the fewest points nearby, where the surface is made up
FORMATS = (".ply", ".obj", ".glb", ".gltf", ".stl")


def check_mesh_path(path: Path) -> None:
    """Check that meshes can be written to files of this suffix, before the work begins.

    Raises:
        ConfigError: unknown suffix.
    """
    if path.suffix.lower() not in FORMATS:
        raise ConfigError(f"{path}: unknown format of a mesh; use one of {', '.join(FORMATS)}")


def write_mesh(path: Path, points: PointMap, voxel_m: float, colour: str = "height") -> int:
    """Write a triangle mesh through the points of a map; the suffix chooses the format.

    Args:
        path: the file, which appears whole.
        points: a map with normals; points without a normal are left out.
        voxel_m: side of the map's voxels: the mesh is as fine.
        colour: of its vertices, by a name of :data:`hybridlio.mapping.colours.COLOURS`.

    Returns:
        The number of triangles.

    Raises:
        ConfigError: the map has no normals, or too many points.
        DataError: no point has a normal, or the file cannot be written.
    """
    check_mesh_path(path)
    if points.normals is None:
        raise ConfigError("a mesh needs normals; build the map with normals")
    if len(points) > MAX_POINTS:
        raise ConfigError(
            f"{len(points)} points are too many for a mesh (at most {MAX_POINTS}); use a larger --voxel or fewer scans"
        )
    import open3d as o3d

    kept = np.flatnonzero(np.einsum("ij,ij->i", points.normals, points.normals) > 0)
    if not len(kept):
        raise DataError("no point of the map has a normal, so there is no surface to mesh")
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.points[kept]))
    cloud.normals = o3d.utility.Vector3dVector(points.normals[kept].astype(np.float64))
    colours = colours_by(points, colour)
    if colours is not None:
        cloud.colors = o3d.utility.Vector3dVector(colours[kept] / 255.0)
    extent_m = float(np.ptp(points.points[kept], axis=0).max())
    depth = min(max(math.ceil(math.log2(max(extent_m / voxel_m, 2.0))), 1), _MAX_DEPTH)
    mesh, raw = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=depth, n_threads=1)
    density = np.asarray(raw, dtype=np.float64)
    mesh.remove_vertices_by_mask((density < np.quantile(density, _UNSUPPORTED)).tolist())
    mesh.compute_vertex_normals()
    mesh.vertex_colors = o3d.utility.Vector3dVector(np.clip(np.asarray(mesh.vertex_colors), 0.0, 1.0))  # extrapolated
    if path.suffix.lower() != ".stl":  # Open3D warns on stdout where a format has no room for them
        mesh.triangle_normals = o3d.utility.Vector3dVector()
    with atomic_path(path) as part:
        if not o3d.io.write_triangle_mesh(part, mesh):
            raise DataError(f"{path}: the mesh cannot be written; choose a place with free space")
        if path.suffix.lower() == ".glb":
            _move_to_binary_chunk(part)
    return len(mesh.triangles)


def _move_to_binary_chunk(path: Path) -> None:
    """Move the buffer of a binary glTF file from its JSON, where Open3D writes it and few programs look, to a chunk.

    Khronos, glTF 2.0 Specification, section 4.4: a header, a JSON chunk padded with spaces, a chunk padded with zeros.
    """
    written = path.read_bytes()
    (size,) = struct.unpack_from("<I", written, 12)
    scene = json.loads(written[20 : 20 + size])
    (buffer,) = scene["buffers"]
    content = base64.b64decode(buffer.pop("uri").partition(",")[2])
    text = json.dumps(scene, separators=(",", ":")).encode()
    text, content = text + b" " * (-len(text) % 4), content + bytes(-len(content) % 4)
    header = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(content))
    chunks = (struct.pack("<I4s", len(text), b"JSON"), text, struct.pack("<I4s", len(content), b"BIN\0"), content)
    path.write_bytes(b"".join((header, *chunks)))
