"""The world that the lidar sees: tiles of ground and objects, and the ray-casting scene of those around the car."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field

import numpy as np

from hybridlio.core.arrays import Array
from hybridlio.simulation.random_streams import RandomStream
from hybridlio.simulation.world.ground import SIDEWALK_END_M, Ground
from hybridlio.simulation.world.items import Item
from hybridlio.simulation.world.rays import RayScene
from hybridlio.simulation.world.shapes import Mesh, merge

TILE_M = 32.0  # many times an object's size; small enough that tiles out of sight are not built
FINE_CELL_M, COARSE_CELL_M = 0.5, 2.0  # of the ground: fine enough for curbs on the road, coarse elsewhere
_FINE_MARGIN_M = 4.0  # the fine ground extends this far beyond the sidewalk
_SIGHT_M = 120.0  # the longest range of a lidar model
_REBUILD_M = 40.0  # distance between scenes: a scene serves some seconds of driving

Tile = tuple[int, int]


@dataclass(eq=False)
class World:
    """Ground and objects by tile. Meshes are built when they come into sight and dropped when out of sight.

    Attributes:
        ground: the ground.
        items: the objects.
        seed: gives each object its shape, the same whenever it is built.
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
        """Return the scene of everything in sight of ``position`` ``(3,)``, world frame.

        The scene depends only on the cell of 40 m that the position is in, not on earlier calls, so a resumed drive
        sees the same triangles.
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
        """Build ground and objects of one tile."""
        low = np.array(tile) * TILE_M
        to_road = float(self.ground.distance(low[None] + TILE_M / 2)[0])
        fine = to_road < SIDEWALK_END_M + _FINE_MARGIN_M + TILE_M * np.sqrt(0.5)
        parts = [self.ground.patch(low, TILE_M, FINE_CELL_M if fine else COARSE_CELL_M)]
        for index in self._by_tile.get(tile, ()):
            item = self.items[index]
            number = index if item.number is None else item.number
            rng = np.random.default_rng([self.seed, RandomStream.ITEM, number])
            parts.append(item.build(rng).placed(item.x, item.y, float(self._item_z[index]), item.yaw))
        return merge(parts)
