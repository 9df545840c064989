"""Voxels: keys name cells, sums do not depend on the order of scans, and tiles on disk are as good as in memory."""

import contextlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridlio.mapping.voxel_tiles import VoxelGrid, VoxelTiles

GRID = VoxelGrid(0.1, 20.0)


def scan(seed: int, spread_m: float = 20.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    points = rng.normal(0, spread_m, (3000, 3))
    return GRID.voxels_of(points, np.array([0.0, 0.0, 2.0]), rng.random(3000).astype(np.float32), float(seed))


def everything(tiles: VoxelTiles) -> np.ndarray:
    rows = np.concatenate([tiles.voxels(tile) for tile in tiles.tiles])
    return rows[np.argsort(rows["key"])]


def filled(scans: list[np.ndarray], max_resident: int = 10**9) -> np.ndarray:
    with contextlib.closing(VoxelTiles(GRID, max_resident)) as tiles:
        for one in scans:
            tiles.add(one)
        return everything(tiles)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(*[st.floats(-9000, 9000)] * 3), min_size=1, max_size=30))
def test_the_mean_of_a_single_point_is_the_point(points: list[tuple[float, float, float]]) -> None:
    at = np.array(points)
    at[:, 2] /= 10
    for point in at:
        voxels = GRID.voxels_of(point[None], np.zeros(3), None, 0.0)
        np.testing.assert_allclose(GRID.means(voxels)[0], point, atol=1e-6)


def test_each_voxel_holds_the_mean_of_its_points() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-3, 3, (5000, 3))
    voxels = GRID.voxels_of(points, np.zeros(3), None, 0.0)
    cells = np.floor(points / 0.1)
    expected = [points[(cells == cell).all(axis=1)].mean(axis=0) for cell in np.unique(cells, axis=0)]
    assert voxels["points"].sum() == len(points)
    found = GRID.means(voxels)
    np.testing.assert_allclose(
        sorted(map(tuple, found.round(5))), sorted(map(tuple, np.array(expected).round(5))), atol=2e-5
    )


def test_the_order_of_scans_does_not_matter() -> None:
    scans = [scan(seed) for seed in range(6)]
    one, other = filled(scans), filled(scans[::-1])
    for name in ("key", "points", "scans", "first_s", "last_s"):
        np.testing.assert_array_equal(one[name], other[name])
    np.testing.assert_allclose(one["offset"], other["offset"], atol=1e-6)


def test_scans_and_times_are_counted_for_each_voxel() -> None:
    rows = filled([scan(3), scan(3), scan(3)])
    assert (rows["scans"] == 3).all()
    assert (rows["first_s"] == 3).all()
    rows = filled([scan(1), scan(4)])
    assert set(np.unique(rows["first_s"])) <= {1.0, 4.0}


@pytest.mark.parametrize("max_resident", [100, 5000])
def test_tiles_on_disk_give_the_same_map(max_resident: int) -> None:
    scans = [scan(seed) for seed in range(6)]
    np.testing.assert_array_equal(filled(scans, max_resident), filled(scans))


def test_memory_stays_near_its_limit() -> None:
    with contextlib.closing(VoxelTiles(GRID, 5000)) as tiles:
        for seed in range(8):
            tiles.add(scan(seed))
            held = sum(map(len, tiles._tiles.values()))
            assert held <= 5000 + 3000  # the limit, and one scan in the tile in use


def test_votes_are_kept_when_a_tile_goes_to_disk() -> None:
    with contextlib.closing(VoxelTiles(GRID, 1)) as tiles:
        tiles.add(scan(0))
        first, *others = tiles.tiles
        tiles.voxels(first)["passes"][:] = 7
        for tile in others:
            tiles.voxels(tile)
        assert (tiles.voxels(first)["passes"] == 7).all()


def test_nearby_tiles_hold_all_points_in_range() -> None:
    rng = np.random.default_rng(5)
    points = rng.uniform(-60, 60, (4000, 3)) * [1, 1, 0.1]
    with contextlib.closing(VoxelTiles(GRID, 10**9)) as tiles:
        tiles.add(GRID.voxels_of(points, np.zeros(3), None, 0.0))
        near = tiles.near(np.array([3.0, -4.0, 0.0]), 9.0)
        inside = np.linalg.norm(points - [3, -4, 0], axis=1) < 9
        held = np.concatenate([GRID.means(tiles.voxels(tile)) for tile in near])
        assert len(near) < len(tiles.tiles)
        for point in points[inside]:
            assert np.abs(held - point).max(axis=1).min() <= 0.1
