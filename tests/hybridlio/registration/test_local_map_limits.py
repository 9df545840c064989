"""The local map's limits at their defaults: keyframes, capacity, horizon, radius, sparse sensors, extent of keys."""

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.registration import voxel_map
from hybridlio.registration.local_map import LocalMap
from hybridlio.registration.settings import LocalMapSettings
from hybridlio.registration.voxel_map import cells_of

DEFAULTS = LocalMapSettings(threads=1)


def at(x_m: float, yaw_deg: float = 0.0) -> np.ndarray:
    return se3.make(se3.so3_exp([0.0, 0.0, np.radians(yaw_deg)]), [x_m, 0.0, 0.0])


def floor(rng: np.random.Generator, half_m: float = 8.0, count: int = 2000) -> np.ndarray:
    """Points on the ground around the lidar, lidar frame."""
    return np.column_stack([rng.uniform(-half_m, half_m, (count, 2)), np.full(count, -1.7)])


def holds(local_map: LocalMap, x_m: float) -> bool:
    """Whether the surface has points within 5 m of a place along x."""
    assert local_map.surface is not None
    return bool((np.abs(local_map.surface.points[:, 0] - x_m) < 5).any())


def test_a_keyframe_is_due_every_few_metres_or_tens_of_degrees(rng: np.random.Generator):
    local_map = LocalMap(DEFAULTS)
    local_map.insert(floor(rng), at(0.0))
    assert [local_map.needs_keyframe(at(x)) for x in (1.0, 4.0)] == [False, True]
    assert [local_map.needs_keyframe(at(0.0, yaw)) for yaw in (5.0, 20.0)] == [False, True]


@pytest.mark.parametrize(("keyframes", "kept"), [(15, True), (40, False)])
def test_a_place_is_dropped_some_tens_of_keyframes_after_it_was_last_hit(
    rng: np.random.Generator, keyframes: int, kept: bool
):
    local_map = LocalMap(DEFAULTS)
    local_map.insert(floor(rng), at(0.0))
    for _ in range(keyframes):
        local_map.insert(floor(rng), at(50.0))
    local_map.insert(floor(rng), at(70.0))
    local_map.rebuild_if_due()
    assert holds(local_map, 0.0) == kept


@pytest.mark.parametrize(("x_m", "kept"), [(70.0, True), (150.0, False)])
def test_a_place_is_left_out_beyond_a_hundred_metres(rng: np.random.Generator, x_m: float, kept: bool):
    local_map = LocalMap(DEFAULTS)
    local_map.insert(floor(rng), at(0.0))
    local_map.insert(floor(rng), at(x_m))
    assert holds(local_map, 0.0) == kept


def test_the_surface_follows_a_vehicle_that_sees_little_new(rng: np.random.Generator):
    """Few points are appended, so that only the distance makes a rebuild due."""
    local_map = LocalMap(LocalMapSettings(threads=1, radius_m=30.0))
    local_map.insert(floor(rng, 25.0, 30_000), at(0.0))
    for x in range(2, 60, 2):
        local_map.insert(floor(rng, 3.0, 60), at(float(x)))
        local_map.rebuild_if_due()
    assert not holds(local_map, 0.0)


def test_a_cell_holds_about_ten_points_some_decimetres_apart(rng: np.random.Generator):
    local_map = LocalMap(DEFAULTS)
    for _ in range(3):
        local_map.insert(floor(rng, 3.0, 120), at(0.0))
    assert local_map.surface is not None
    points = local_map.surface.points
    _, counts = np.unique(np.floor(points / DEFAULTS.voxel_m), axis=0, return_counts=True)
    assert 6 <= np.median(counts) <= 15
    apart = np.linalg.norm(points[120:, None] - points[:100], axis=2)
    assert apart.min() < 0.4


@pytest.mark.parametrize(("share", "sparse"), [(0.01, False), (0.16, True)], ids=["64 beams", "16 beams"])
def test_a_sensor_is_sparse_if_many_near_points_are_on_single_rings(
    rng: np.random.Generator, share: float, sparse: bool
):
    """16 beams have one such point in six, 64 beams hardly any; distant points do not count."""
    near, distant = floor(rng, 10.0, 1000), floor(rng, 10.0, 1000) + np.array([40.0, 0.0, 0.0])
    on_one_ring = np.concatenate([near[: int(share * 1000)], distant])
    assert voxel_map._is_sparse(np.concatenate([near, distant]), on_one_ring, voxel_map._SPARSE_RANGE * 2.0) == sparse


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_cells_within_a_thousand_kilometres_have_different_keys(axis: int):
    """Along an axis, and in a slab two cells thick around it."""
    along = np.r_[np.linspace(-1e6, 1e6, 1000), np.arange(-1000.0, 1000.0, 2.0)]
    points = np.zeros((4000, 3))
    points[:, axis] = np.tile(along, 2)
    points[2000:, axis - 1] = 3.0
    keys = [int(cells_of(point[None], 2.0)[1][0]) for point in points]
    assert len(set(keys)) == len(np.unique(np.floor(points.astype(np.float32) / np.float32(2)), axis=0))
