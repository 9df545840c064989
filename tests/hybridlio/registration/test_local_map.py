import numpy as np
import pytest
import small_gicp

from hybridlio.core import se3
from hybridlio.registration.icp import register
from hybridlio.registration.local_map import LocalMap
from hybridlio.registration.settings import LocalMapSettings, RegistrationSettings

SETTINGS = LocalMapSettings(threads=1)


def at(x: float, yaw_deg: float = 0.0) -> np.ndarray:
    return se3.make(se3.so3_exp([0.0, 0.0, np.radians(yaw_deg)]), [x, 0.0, 0.0])


def floor(rng: np.random.Generator, half_m: float = 10.0, height_m: float = -1.7, count: int = 4000) -> np.ndarray:
    """Points on the ground around the lidar, lidar frame."""
    return np.column_stack([rng.uniform(-half_m, half_m, (count, 2)), np.full(count, height_m)])


def test_an_empty_map_has_no_surface_and_needs_a_keyframe():
    local_map = LocalMap(SETTINGS)
    assert local_map.surface is None
    assert local_map.needs_keyframe(at(0.0))


def test_a_scan_becomes_a_keyframe_once_it_is_far_enough_or_turned_enough(rng: np.random.Generator):
    local_map = LocalMap(SETTINGS)
    local_map.insert(floor(rng), at(0.0))
    assert not local_map.needs_keyframe(at(0.9 * SETTINGS.keyframe_m))
    assert local_map.needs_keyframe(at(1.1 * SETTINGS.keyframe_m))
    assert not local_map.needs_keyframe(at(0.0, 0.9 * SETTINGS.keyframe_deg))
    assert local_map.needs_keyframe(at(0.0, -1.1 * SETTINGS.keyframe_deg))
    local_map.insert(floor(rng), at(5.0, 90.0))
    assert not local_map.needs_keyframe(at(5.0, 90.0))
    assert local_map.needs_keyframe(at(0.0))


def test_a_map_of_one_scan_covers_no_ground_between_its_rings(rng: np.random.Generator):
    angles = rng.uniform(0, 2 * np.pi, (2, 2000))
    rings, between = (
        np.column_stack([range_m * np.cos(a), range_m * np.sin(a), np.full(2000, -1.7)])
        for range_m, a in zip((rng.uniform(5, 6, 2000), rng.uniform(9, 10, 2000)), angles, strict=True)
    )
    local_map, both = LocalMap(SETTINGS), np.vstack([rings, between])
    assert local_map.covered(both, at(0.0), 1.0) == np.inf  # of no map nothing is known
    for keyframes in range(1, 6):
        local_map.insert(rings, at(0.0))
        assert local_map.covered(both, at(0.0), 1.0) == (len(rings) if keyframes < 5 else np.inf)


def test_the_surface_lies_where_the_scans_were_taken(rng: np.random.Generator):
    local_map = LocalMap(SETTINGS)
    tilt = se3.make(se3.so3_exp([0.0, 0.1, 0.5]), [30.0, -20.0, 4.0])
    local_map.insert(se3.transform(se3.inverse(tilt), floor(rng)), tilt)
    surface = local_map.surface
    assert surface is not None
    np.testing.assert_allclose(surface.points[:, 2], -1.7, atol=1e-6)
    np.testing.assert_allclose(np.abs(surface.normals[:, 2]), 1.0, atol=1e-6)


def test_all_normals_are_unit_vectors(rng: np.random.Generator):
    local_map = LocalMap(SETTINGS)
    lonely = np.array([[50.0, 50.0, 20.0], [-60.0, 10.0, 5.0]])
    local_map.insert(np.concatenate([floor(rng), lonely]), at(0.0))
    assert local_map.surface is not None
    np.testing.assert_allclose(np.linalg.norm(local_map.surface.normals, axis=1), 1.0, atol=1e-6)


def test_the_map_covers_all_keyframes(rng: np.random.Generator):
    local_map = LocalMap(SETTINGS)
    for x in range(0, 30, 5):
        local_map.insert(floor(rng), at(float(x)))
    assert local_map.surface is not None
    x = local_map.surface.points[:, 0]
    assert x.min() < -9
    assert x.max() > 34


def test_scans_of_the_same_place_stop_growing_the_map(rng: np.random.Generator):
    local_map, sizes = LocalMap(SETTINGS), []
    for _ in range(12):
        local_map.insert(floor(rng), at(0.0))
        assert local_map.surface is not None
        sizes.append(len(local_map.surface.points))
    cells = (2 * 10 / SETTINGS.voxel_m + 1) ** 2
    assert max(sizes) <= 10 * cells
    assert sizes[-1] - sizes[-4] < 0.05 * sizes[-1]


def test_points_outside_the_radius_are_left_out(rng: np.random.Generator):
    local_map = LocalMap(LocalMapSettings(radius_m=15.0, threads=1))
    local_map.insert(floor(rng), at(0.0))
    local_map.insert(floor(rng), at(20.0))
    assert local_map.surface is not None
    distance = np.linalg.norm(local_map.surface.points - [20.0, 0.0, 0.0], axis=1)
    assert distance.max() < 15.0
    assert (local_map.surface.points[:, 0] < 10.0).any()  # points of the first keyframe within it stay


def test_cells_not_hit_within_the_horizon_are_dropped(rng: np.random.Generator):
    local_map = LocalMap(LocalMapSettings(horizon_keyframes=6, threads=1, radius_m=1000.0))
    local_map.insert(floor(rng), at(0.0))
    for k in range(1, 20):
        local_map.insert(floor(rng), at(100.0 + k))
    assert local_map.surface is not None
    assert local_map.surface.points[:, 0].min() > 80.0


def test_a_cell_holds_ten_points_with_a_minimum_spacing(rng: np.random.Generator):
    local_map = LocalMap(SETTINGS)
    first, again = floor(rng, 3.0, count=60), floor(rng, 3.0, count=400)
    local_map.insert(first, at(0.0))
    assert local_map.surface is not None
    before = local_map.surface.points
    local_map.insert(again, at(0.0))
    after = local_map.surface.points
    _, counts = np.unique(np.floor(after / SETTINGS.voxel_m), axis=0, return_counts=True)
    assert counts.max() == 10
    assert len(after) > len(before)  # there was room
    np.testing.assert_array_equal(after[: len(before)], before)
    apart = np.linalg.norm(after[len(before) :, None] - before, axis=2)
    assert apart.min() >= 0.1


def test_normals_are_those_of_small_gicp_over_the_whole_scan(rng: np.random.Generator):
    """Planes are fitted to the added points only, and equal those that small_gicp fits to all points."""
    points = np.concatenate([floor(rng), floor(rng)[:, [2, 0, 1]]]) + 0.01 * rng.standard_normal((8000, 3))
    local_map = LocalMap(LocalMapSettings(threads=1, voxel_m=0.5))
    local_map.insert(points, np.eye(4))
    cloud = small_gicp.PointCloud(points)
    small_gicp.estimate_normals(cloud, None, LocalMapSettings().neighbours, 1)
    surface = local_map.surface
    assert surface is not None
    index, distance2 = small_gicp.KdTree(points, 1).batch_knn_search(surface.points, 1, 1)
    np.testing.assert_array_equal(distance2, 0.0)
    cosines = np.abs(np.einsum("ij,ij->i", surface.normals, cloud.normals()[index[:, 0], :3]))
    assert np.mean(cosines > 1 - 1e-6) > 0.999  # except at edges, where the plane is ambiguous


def test_the_nearest_point_is_that_of_a_brute_force_search(rng: np.random.Generator):
    local_map = LocalMap(SETTINGS)
    local_map.insert(floor(rng), at(0.0))
    surface = local_map.surface
    assert surface is not None
    queries = rng.uniform(-5, 5, (50, 3))
    index, distance2 = surface.nearest(queries, 1)
    brute = ((queries[:, None] - surface.points) ** 2).sum(axis=2)
    np.testing.assert_allclose(distance2, brute.min(axis=1), rtol=1e-9)
    np.testing.assert_array_equal(index, brute.argmin(axis=1))


@pytest.mark.parametrize("threads", [1, 2])
def test_the_same_scans_give_the_same_bytes(threads: int):
    surfaces = []
    for _ in range(2):
        rng, local_map = np.random.default_rng(5), LocalMap(LocalMapSettings(threads=threads))
        for x in range(3):
            local_map.insert(floor(rng) + 0.02 * rng.standard_normal((4000, 3)), at(float(2 * x), 5.0 * x))
        surfaces.append(local_map.surface)
    first, again = surfaces
    assert first is not None
    assert again is not None
    assert first.points.tobytes() == again.points.tobytes()
    assert first.normals.tobytes() == again.normals.tobytes()


@pytest.mark.parametrize(("beams_deg", "planes"), [((1.0,), False), ((0.0, 1.0, 2.0), True)], ids=["one beam", "three"])
def test_points_of_one_beam_make_no_plane(beams_deg: tuple[float, ...], planes: bool):
    """One beam sees a wall 20 m away as a line, horizontal and slightly curved, in a plane that is not the wall's."""
    left = np.arange(-6.0, 6.0, 0.6)
    rings = [
        np.column_stack([np.full_like(left, 20.0), left, np.hypot(20.0, left) * np.tan(np.radians(b))])
        for b in beams_deg
    ]
    local_map = LocalMap(SETTINGS)
    local_map.insert(np.concatenate(rings), at(0.0))
    assert (local_map.surface is not None) == planes
    if local_map.surface is not None:
        assert (np.abs(local_map.surface.normals[:, 0]) > 0.999).mean() > 0.9


def test_thicker_planes_weigh_less(rng: np.random.Generator):
    """Ground with a lidar's noise has full weight, rough ground somewhat less, a hedge little."""
    local_map, middles = LocalMap(SETTINGS), {"smooth": 0.0, "rough": 40.0, "hedge": -40.0}
    for half_thick_m, x in zip((0.01, 0.05, 1.2), middles.values(), strict=True):
        points = floor(rng) + np.array([x, 0.0, 0.0])
        points[:, 2] += rng.uniform(-half_thick_m, half_thick_m, len(points))
        local_map.insert(points, at(0.0))
    assert local_map.surface is not None
    planes = local_map.surface.planes(np.arange(len(local_map.surface.points)))
    x = local_map.surface.points[:, 0]
    weight = {name: np.median(planes[np.abs(x - middle) < 12, 4]) for name, middle in middles.items()}
    assert weight["smooth"] > 0.99
    assert 0.8 < weight["rough"] < weight["smooth"]
    assert weight["hedge"] < 0.4


def test_rebuilding_does_not_change_the_points_of_the_surface(rng: np.random.Generator):
    """Without ``rebuild_if_due`` a keyframe rebuilds the surface when that is overdue; with it, none has to."""
    left, tidied, worn = LocalMap(SETTINGS), LocalMap(SETTINGS), []
    for x in range(0, 24, 2):
        points = floor(rng)
        for local_map in (left, tidied):
            local_map.insert(points, at(float(x)))
        tidied.rebuild_if_due()
        assert left.surface is not None
        assert tidied.surface is not None
        rows = [surface.points[np.lexsort(surface.points.T)] for surface in (left.surface, tidied.surface)]
        np.testing.assert_array_equal(*rows)
        worn.append(left.surface.appended_ratio)
        assert tidied.surface.appended_ratio < 0.13
    assert (np.diff(worn) < 0).any()
    assert max(worn) < 0.3


def test_rebuilding_an_empty_map_does_nothing():
    local_map = LocalMap(SETTINGS)
    local_map.rebuild_if_due()
    assert local_map.surface is None


def test_the_next_room_does_not_pull_at_the_wall_as_seen_from_this_one(rng: np.random.Generator):
    """The two faces of a wall are 12 cm apart, and only one of them is in the map."""
    sides = [floor(rng, 3.0, -1.5), floor(rng, 3.0, -1.5)[:, [1, 2, 0]] - [0.0, 1.5, 0.0]]
    local_map = LocalMap(LocalMapSettings(threads=1, one_sided=True))
    local_map.insert(np.concatenate([*sides, wall_at(rng, 3.0)]), at(0.0))
    here = at(5.0)
    scan = np.concatenate([se3.transform(se3.inverse(here), np.concatenate(sides)), wall_at(rng, -1.88)])
    assert local_map.surface is not None
    found = register(local_map.surface, scan, here, RegistrationSettings(threads=1))
    assert np.linalg.norm(found.pose[:3, 3] - here[:3, 3]) < 0.01


def wall_at(rng: np.random.Generator, x_m: float) -> np.ndarray:
    return np.column_stack([np.full(2000, x_m), rng.uniform(-1.5, 1.5, (2000, 2))])
