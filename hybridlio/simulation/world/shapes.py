"""Triangle meshes with a reflectance per face, and the basic shapes of which objects are composed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from hybridlio.core.arrays import Array, Index

# the corners of a unit cube around the origin, and the three corners of each of its twelve triangles
_CUBE = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_CUBE_FACES = np.array(
    [0, 1, 3, 0, 3, 2, 4, 6, 7, 4, 7, 5, 0, 4, 5, 0, 5, 1, 2, 3, 7, 2, 7, 6, 0, 2, 6, 0, 6, 4, 1, 5, 7, 1, 7, 3]
).reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh.

    Attributes:
        vertices: ``(V, 3)`` in metres.
        triangles: ``(F, 3)`` indices of vertices.
        reflectance: ``(F,)`` share of the light that a face reflects, 0 to 1.
    """

    vertices: Array
    triangles: Index
    reflectance: Array

    @classmethod
    def empty(cls) -> Mesh:
        """Return a mesh without triangles."""
        return cls(np.empty((0, 3)), np.empty((0, 3), np.int64), np.empty(0))

    def placed(self, x: float, y: float, z: float, yaw: float) -> Mesh:
        """Return the mesh rotated about its z axis by ``yaw`` radians, then translated."""
        c, s = np.cos(yaw), np.sin(yaw)
        R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return Mesh(self.vertices @ R.T + [x, y, z], self.triangles, self.reflectance)

    def moved(self, offset_m: ArrayLike) -> Mesh:
        """Return the mesh translated by ``offset_m`` ``(3,)``."""
        return Mesh(self.vertices + np.asarray(offset_m), self.triangles, self.reflectance)


def merge(meshes: Iterable[Mesh]) -> Mesh:
    """Merge meshes into one."""
    parts = [m for m in meshes if len(m.triangles)]
    if not parts:
        return Mesh.empty()
    starts = np.cumsum([0] + [len(m.vertices) for m in parts[:-1]])
    return Mesh(
        np.concatenate([m.vertices for m in parts]),
        np.concatenate([m.triangles + start for m, start in zip(parts, starts, strict=True)]),
        np.concatenate([m.reflectance for m in parts]),
    )


def boxes(low: ArrayLike, high: ArrayLike, reflectance: float) -> Mesh:
    """Return axis-parallel boxes from corners ``low`` to corners ``high``, each ``(B, 3)`` or ``(3,)``."""
    low, high = np.atleast_2d(np.asarray(low, dtype=np.float64)), np.atleast_2d(np.asarray(high, dtype=np.float64))
    low, high = np.broadcast_arrays(low, high)
    vertices = ((low + high) / 2)[:, None] + _CUBE * (high - low)[:, None]
    faces = _CUBE_FACES + 8 * np.arange(len(low))[:, None, None]
    return Mesh(vertices.reshape(-1, 3), faces.reshape(-1, 3), np.full(12 * len(low), reflectance))


def prism(profile: ArrayLike, low_y: float, high_y: float, reflectance: float, top_inset: float = 0.0) -> Mesh:
    """Extrude a convex profile ``(K, 2)`` of x and z, counter-clockwise, along y from ``low_y`` to ``high_y``.

    ``top_inset`` narrows the body, linearly with height, by this many metres on either side at the top.
    """
    profile = np.asarray(profile, dtype=np.float64)
    count = len(profile)
    rise = (profile[:, 1] - profile[:, 1].min()) / max(float(np.ptp(profile[:, 1])), 1e-9)
    right = np.column_stack([profile[:, 0], low_y + top_inset * rise, profile[:, 1]])
    left = np.column_stack([profile[:, 0], high_y - top_inset * rise, profile[:, 1]])
    fan = np.array([[0, i, i + 1] for i in range(1, count - 1)])
    i, j = np.arange(count), np.roll(np.arange(count), -1)
    sides = np.concatenate([np.column_stack([i, i + count, j]), np.column_stack([j, i + count, j + count])])
    faces = np.concatenate([fan, fan[:, ::-1] + count, sides])
    return Mesh(np.concatenate([right, left]), faces, np.full(len(faces), reflectance))


def cylinder(
    radius_low: float, radius_high: float, low_z: float, high_z: float, reflectance: float, sides: int = 8
) -> Mesh:
    """Return an upright cylinder on the z axis, tapered if the radii differ, open at the bottom."""
    angle = np.arange(sides) * 2 * np.pi / sides
    ring = np.column_stack([np.cos(angle), np.sin(angle)])
    low = np.column_stack([ring * radius_low, np.full(sides, low_z)])
    high = np.column_stack([ring * radius_high, np.full(sides, high_z)])
    i, j = np.arange(sides), np.roll(np.arange(sides), -1)
    walls = np.concatenate([np.column_stack([i, j, i + sides]), np.column_stack([j, j + sides, i + sides])])
    lid = np.column_stack([i + sides, j + sides, np.full(sides, 2 * sides)])
    vertices = np.concatenate([low, high, [[0.0, 0.0, high_z]]])
    faces = np.concatenate([walls, lid])
    return Mesh(vertices, faces, np.full(len(faces), reflectance))


def facets(centres: Array, size_m: float, reflectance: float, rng: np.random.Generator) -> Mesh:
    """Return one small triangle of random attitude at each centre ``(N, 3)``: foliage, as a lidar sees it."""
    corners = centres[:, None] + rng.normal(0.0, size_m, (len(centres), 3, 3))
    shades = np.clip(reflectance + rng.normal(0.0, 0.06, len(centres)), 0.05, 1.0)
    return Mesh(corners.reshape(-1, 3), np.arange(3 * len(centres)).reshape(-1, 3), shades)
