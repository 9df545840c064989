"""The voxels of a map, tile by tile: sums that scans are added to, of which those not in use wait on disk.

A map of 10 km by a lidar of 64 beams has some 100 million voxels of 0.1 m, more than fits in memory; but scans only
ever touch the tiles within their range.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TypeAlias

import numpy as np

from hybridlio.core.arrays import Array, Floats, Index

Tile: TypeAlias = tuple[int, int]  # column and row, in units of the tile's side

# Bits of a voxel's key, from the highest: column and row of its tile, then its x, y and z. Sorted keys are therefore
# sorted by tile. 12 bits are 4096 tiles of 50 m, 200 km; 18 bits are 26 km of height at 0.1 m.
_TILE_BITS, _SIDE_BITS, _HEIGHT_BITS = 12, 10, 18
_IN_TILE_BITS = 2 * _SIDE_BITS + _HEIGHT_BITS
MAX_SIDE = 1 << _SIDE_BITS  # voxels along a tile's side
# One voxel: its key, and sums over the scans that hit it. Of the scans that `moving_points` compares, `agrees` counts
# those that see a surface in the voxel and `passes` those that see through it.
VOXELS = np.dtype(
    [
        ("key", "<i8"),
        ("offset", "<f4", 3),  # sum of points relative to the voxel's corner, metres
        ("towards", "<f4", 3),  # sum of unit vectors towards the lidar
        ("intensity", "<f4"),
        ("points", "<u4"),
        ("scans", "<u2"),
        ("agrees", "<u2"),
        ("passes", "<u2"),
        ("first_s", "<f4"),  # since the map's first scan
        ("last_s", "<f4"),
    ]
)
_SUMS, _COUNTS = ("offset", "towards", "intensity", "points"), ("scans", "agrees", "passes")
_COUNT_LIMIT = np.iinfo(np.uint16).max
_MIN_MERGED = 10_000  # new voxels; fewer are merged when there are a quarter as many as known ones
Voxels: TypeAlias = np.ndarray[tuple[int], np.dtype[np.void]]  # of type VOXELS


class VoxelGrid:
    """Voxels numbered by keys, and the tiles that they form.

    Args:
        voxel_m: side of the voxels.
        tile_m: side of the tiles; rounded to whole voxels, at most :data:`MAX_SIDE`.
    """

    def __init__(self, voxel_m: float, tile_m: float) -> None:
        self.voxel_m = voxel_m
        self._side = min(max(round(tile_m / voxel_m), 1), MAX_SIDE)

    @property
    def tile_m(self) -> float:
        """Side of the tiles."""
        return self._side * self.voxel_m

    def voxels_of(self, points: Array, lidar_position: Array, intensity: Floats | None, time_s: float) -> Voxels:
        """Return the voxels ``(M,)``, sorted by key, that the points of one scan hit.

        Args:
            points: ``(N, 3)`` metres, world frame.
            lidar_position: ``(3,)`` of the lidar, world frame.
            intensity: ``(N,)`` or None.
            time_s: the scan's time since the map's first scan.
        """
        cells = np.floor(points / self.voxel_m)
        keys = self._keys(cells.astype(np.int64))
        order = np.argsort(keys)
        keys = keys[order]
        starts = np.flatnonzero(np.diff(keys, prepend=-1))
        out = np.zeros(len(starts), VOXELS)
        if not len(starts):
            return out
        towards = lidar_position - points
        towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-9)
        sums = np.column_stack([points - cells * self.voxel_m, towards]).astype(np.float32)
        sums = np.add.reduceat(sums[order], starts, axis=0)
        out["key"], out["offset"], out["towards"] = keys[starts], sums[:, :3], sums[:, 3:]
        if intensity is not None:
            out["intensity"] = np.add.reduceat(intensity[order], starts)
        out["points"] = np.diff(np.append(starts, len(keys)))
        out["scans"], out["first_s"], out["last_s"] = 1, time_s, time_s
        return out

    def means(self, voxels: Voxels) -> Array:
        """Return the mean point ``(M, 3)`` of each voxel, in metres."""
        return np.asarray(self._cells(voxels["key"]) * self.voxel_m + voxels["offset"] / voxels["points"][:, None])

    def by_tile(self, voxels: Voxels) -> Iterator[tuple[Tile, Voxels]]:
        """Yield tiles and their part of voxels that are sorted by key."""
        tiles = voxels["key"] >> _IN_TILE_BITS
        starts = np.flatnonzero(np.diff(tiles, prepend=-1))
        for start, end in zip(starts, [*starts[1:], len(tiles)], strict=True):
            column, row = (int(n) - (1 << (_TILE_BITS - 1)) for n in divmod(int(tiles[start]), 1 << _TILE_BITS))
            yield (column, row), voxels[start:end]

    def _keys(self, cells: Index) -> Index:
        (column, x), (row, y) = (np.divmod(cells[:, axis], self._side) for axis in (0, 1))
        key = (column + (1 << (_TILE_BITS - 1))) << _TILE_BITS | (row + (1 << (_TILE_BITS - 1)))
        key = (key << _SIDE_BITS | x) << _SIDE_BITS | y
        return np.asarray(key << _HEIGHT_BITS | (cells[:, 2] + (1 << (_HEIGHT_BITS - 1))))

    def _cells(self, keys: Index) -> Index:
        shifts = np.cumsum([_HEIGHT_BITS, _SIDE_BITS, _SIDE_BITS, _TILE_BITS])
        z = (keys & ((1 << _HEIGHT_BITS) - 1)) - (1 << (_HEIGHT_BITS - 1))
        y, x = (keys >> shift & (MAX_SIDE - 1) for shift in shifts[:2])
        row, column = ((keys >> shift & ((1 << _TILE_BITS) - 1)) - (1 << (_TILE_BITS - 1)) for shift in shifts[2:])
        return np.column_stack([column * self._side + x, row * self._side + y, z])


class _TileVoxels:
    """The voxels of one tile: those known, sorted by key, and new ones that wait to be merged."""

    def __init__(self, known: Voxels) -> None:
        self.known, self._new = known, [known[:0]]

    def __len__(self) -> int:
        return len(self.known) + sum(map(len, self._new))

    def add(self, voxels: Voxels) -> None:
        rows = np.searchsorted(self.known["key"], voxels["key"])
        is_known = rows < len(self.known)
        is_known[is_known] = self.known["key"][rows[is_known]] == voxels["key"][is_known]
        _accumulate(self.known, rows[is_known], voxels[is_known])
        self._new.append(voxels[~is_known])
        if sum(map(len, self._new)) > max(len(self.known) // 4, _MIN_MERGED):
            self.merge()

    def merge(self) -> None:
        self.known = _merged([self.known, *self._new])
        self._new = [self.known[:0]]


class VoxelTiles:
    """All voxels of a map, in square tiles of the horizontal plane.

    Args:
        grid: the voxels' sides and keys.
        max_resident: voxels to keep in memory.
    """

    def __init__(self, grid: VoxelGrid, max_resident: int) -> None:
        self.grid, self._max_resident = grid, max_resident
        self._tiles: dict[Tile, _TileVoxels] = {}  # in memory; the least recently used first
        self._stored: set[Tile] = set()
        self._folder: tempfile.TemporaryDirectory[str] | None = None

    def close(self) -> None:
        """Remove the files on disk."""
        if self._folder is not None:
            self._folder.cleanup()

    @property
    def tiles(self) -> list[Tile]:
        """All tiles that scans have hit, sorted."""
        return sorted({*self._tiles, *self._stored})

    def add(self, voxels: Voxels) -> None:
        """Add the voxels that one scan hit, from :meth:`VoxelGrid.voxels_of`."""
        for tile, part in self.grid.by_tile(voxels):
            self._load(tile).add(part)
        self._make_room()

    def voxels(self, tile: Tile) -> Voxels:
        """Return the voxels of a tile, one row each, sorted by key; changes to ``agrees`` and ``passes`` are kept."""
        held = self._load(tile)
        held.merge()
        self._make_room()
        return held.known

    def near(self, position: Array, range_m: float) -> list[Tile]:
        """Return the tiles that the square around a circle meets."""
        low, high = (np.floor((position[:2] + sign * range_m) / self.grid.tile_m).astype(int) for sign in (-1, 1))
        wanted = [(x, y) for x in range(low[0], high[0] + 1) for y in range(low[1], high[1] + 1)]
        return [tile for tile in wanted if tile in self._tiles or tile in self._stored]

    def _load(self, tile: Tile) -> _TileVoxels:
        """Return a tile, from disk where it is there, and mark it as the most recently used."""
        held = self._tiles.pop(tile, None)
        if held is None:
            stored = tile in self._stored
            held = _TileVoxels(np.load(self._file(tile), allow_pickle=False) if stored else np.empty(0, VOXELS))
            self._stored.discard(tile)
        self._tiles[tile] = held
        return held

    def _make_room(self) -> None:
        """Write the tiles used least recently to disk, until a quarter of the memory is free."""
        resident = sum(map(len, self._tiles.values()))
        if resident <= self._max_resident:
            return
        for tile in list(self._tiles)[:-1]:  # never the one in use
            if resident <= 0.75 * self._max_resident:
                return
            held = self._tiles.pop(tile)
            resident -= len(held)
            held.merge()
            np.save(self._file(tile), held.known, allow_pickle=False)
            self._stored.add(tile)

    def _file(self, tile: Tile) -> Path:
        if self._folder is None:
            self._folder = tempfile.TemporaryDirectory(prefix="hybridlio-map-")
        return Path(self._folder.name) / f"{tile[0]}_{tile[1]}.npy"


def _merged(parts: list[Voxels]) -> Voxels:
    """Return one row for each voxel, sorted by key."""
    parts = [part for part in parts if len(part)] or parts[:1]
    if len(parts) == 1:
        return parts[0]
    rows = np.concatenate(parts)
    rows = rows[np.argsort(rows["key"], kind="stable")]  # merges sorted parts in linear time
    starts = np.flatnonzero(np.diff(rows["key"], prepend=-1))
    out = rows[starts]
    repeated = np.setdiff1d(np.arange(len(rows)), starts, assume_unique=True)
    for number in range(1, int(np.diff(np.append(starts, len(rows))).max())):  # the second of each voxel, the third, …
        into = np.searchsorted(starts, repeated, side="right") - 1
        now = repeated - starts[into] == number
        _accumulate(out, into[now], rows[repeated[now]])
    return out


def _accumulate(into: Voxels, rows: Index, more: Voxels) -> None:
    """Add voxels to rows of others, each row at most once."""
    for name in _SUMS:
        into[name][rows] += more[name]
    for name in _COUNTS:
        into[name][rows] = np.minimum(into[name][rows] + more[name].astype(np.int64), _COUNT_LIMIT)
    into["first_s"][rows] = np.minimum(into["first_s"][rows], more["first_s"])
    into["last_s"][rows] = np.maximum(into["last_s"][rows], more["last_s"])
