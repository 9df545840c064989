"""The world that the lidar sees: tiles of ground and things, and one ray-casting scene of those around the car."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridlio.core.arrays import Array
from hybridlio.simulation.world.ground import SIDEWALK_END_M, Ground
from hybridlio.simulation.world.layout import Item
from hybridlio.simulation.world.shapes import Mesh, merge

TILE_M = 32.0
FINE_CELL_M, COARSE_CELL_M = 0.5, 2.0
_SIGHT_M = 120.0
_REBUILD_M = 40.0

Tile = tuple[int, int]


@dataclass(frozen=True, eq=False)
class Hits:
    """What rays meet first.

    Attributes:
        range_m: ``(R,)`` metres along the ray, infinite where there is nothing.
        cosine: ``(R,)`` of the angle of incidence, 0 where there is nothing.
        reflectance: ``(R,)``, 0 where there is nothing.
    """

    range_m: Array
    cosine: Array
    reflectance: Array

    def take_nearer(self, rows: NDArray[np.intp], others: Hits) -> None:
        """Put ``others``, hits of the rays ``rows``, where they are nearer."""
        nearer = others.range_m < self.range_m[rows]
        for mine, theirs in zip(vars(self).values(), vars(others).values(), strict=True):
            mine[rows[nearer]] = theirs[nearer]


@dataclass(eq=False)
class RayScene:
    """Triangles ready for rays; everything relative to ``origin`` ``(3,)``, for single precision's sake."""

    origin: Array
    reflectance: Array
    scene: Any

    @classmethod
    def of(cls, mesh: Mesh, origin: Array) -> RayScene:
        """Build the acceleration structure (Embree, by Open3D)."""
        import open3d as o3d

        scene = o3d.t.geometry.RaycastingScene()
        vertices = np.ascontiguousarray(mesh.vertices - origin, dtype=np.float32)
        triangles = np.ascontiguousarray(mesh.triangles, dtype=np.uint32)
        scene.add_triangles(o3d.core.Tensor.from_numpy(vertices), o3d.core.Tensor.from_numpy(triangles))
        return cls(origin, np.append(mesh.reflectance, 0.0), scene)

    def cast(self, origins: Array, directions: Array) -> Hits:
        """First hits of rays from ``origins`` along unit ``directions``, each ``(R, 3)``."""
        import open3d as o3d

        rays = np.empty((len(directions), 6), dtype=np.float32)
        rays[:, :3], rays[:, 3:] = origins - self.origin, directions
        answer = self.scene.cast_rays(o3d.core.Tensor.from_numpy(rays))
        faces = np.minimum(answer["primitive_ids"].numpy(), len(self.reflectance) - 1)
        normals = answer["primitive_normals"].numpy()
        cosine = np.abs(np.einsum("ni,ni->n", normals, rays[:, 3:]))
        return Hits(answer["t_hit"].numpy().astype(np.float64), cosine, self.reflectance[faces])


@dataclass(eq=False)
class World:
    """Ground and things by tile; meshes are made when first in sight and dropped when far behind.

    The same ``seed`` gives every thing the same shape whenever it is built.
    """

    ground: Ground
    items: list[Item]
    seed: int
    _by_tile: dict[Tile, list[int]] = field(default_factory=dict)
    _meshes: dict[Tile, Mesh] = field(default_factory=dict)
    _scene: RayScene | None = None

    def __post_init__(self) -> None:
        by_tile: dict[Tile, list[int]] = defaultdict(list)
        for index, item in enumerate(self.items):
            by_tile[(int(item.x // TILE_M), int(item.y // TILE_M))].append(index)
        self._by_tile = dict(by_tile)
        self._item_z = self.ground.height(np.array([(i.x, i.y) for i in self.items]).reshape(-1, 2))

    def scene_around(self, position: Array) -> RayScene:
        """The scene of everything in sight of ``position`` ``(3,)``; rebuilt every _REBUILD_M or so.

        Which scene serves a position depends on the position alone, so a resumed drive sees the same triangles.
        """
        cell = np.round(position / _REBUILD_M) * _REBUILD_M
        if self._scene is None or not np.array_equal(self._scene.origin, cell):
            low = np.floor((cell[:2] - _SIGHT_M) / TILE_M).astype(int)
            high = np.floor((cell[:2] + _SIGHT_M) / TILE_M).astype(int)
            tiles = [(i, j) for i in range(low[0], high[0] + 1) for j in range(low[1], high[1] + 1)]
            self._meshes = {tile: self._meshes.get(tile) or self.tile_mesh(tile) for tile in tiles}
            self._scene = RayScene.of(merge(self._meshes.values()), cell)
        return self._scene

    def tile_mesh(self, tile: Tile) -> Mesh:
        """Ground and things of one tile."""
        low = np.array(tile) * TILE_M
        to_road = float(self.ground.distance(low[None] + TILE_M / 2)[0])
        fine = to_road < SIDEWALK_END_M + 4.0 + TILE_M * np.sqrt(0.5)
        parts = [self.ground.patch(low, TILE_M, FINE_CELL_M if fine else COARSE_CELL_M)]
        for index in self._by_tile.get(tile, ()):
            item = self.items[index]
            rng = np.random.default_rng([self.seed, 7, index])
            parts.append(item.build(rng).placed(item.x, item.y, float(self._item_z[index]), item.yaw))
        return merge(parts)
