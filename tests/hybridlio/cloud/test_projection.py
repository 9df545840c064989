import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridlio.cloud.map_geometry import MAP_GEOMETRIES, MapGeometry, map_geometry
from hybridlio.cloud.projection import gather, normal_map, remap, valid_cells, vertex_map, winner_map
from hybridlio.core import se3
from hybridlio.core.errors import ConfigError
from hybridlio.core.lidar_models import LIDAR_MODELS

PAPER = MAP_GEOMETRIES["hdl-64e"]


def rays(geometry: MapGeometry) -> np.ndarray:
    """Return unit directions (H, W, 3) through the centres of the cells."""
    elevation = np.radians(geometry.fov_up_deg - (np.arange(geometry.rows) + 0.5) * geometry.row_deg)[:, None]
    azimuth = np.radians(180.0 - (np.arange(geometry.columns) + 0.5) * geometry.column_deg)[None, :]
    return np.stack(
        np.broadcast_arrays(
            np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)
        ),
        axis=-1,
    )


def cloud(seed: int, count: int = 20_000) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return (rng.normal(size=(count, 3)) * [20.0, 20.0, 2.0]).astype(np.float32)


def test_the_papers_map_has_52_rows_of_720_cells_of_half_a_degree_from_plus_3_to_minus_23():
    assert (PAPER.rows, PAPER.columns, PAPER.row_deg, PAPER.column_deg) == (52, 720, 0.5, 0.5)
    assert (PAPER.fov_up_deg, PAPER.fov_down_deg) == (3.0, -23.0)


@pytest.mark.parametrize("name", ["32-beam", "16-beam"])
def test_every_beam_of_an_evenly_spaced_lidar_has_its_own_row(name):
    geometry, elevations = MAP_GEOMETRIES[name], np.array(LIDAR_MODELS[name].elevations_deg)
    row = (geometry.fov_up_deg - elevations) / geometry.row_deg
    assert np.allclose(row, np.arange(len(elevations)) + 0.5)


def test_an_unknown_lidar_is_an_error_that_lists_the_known_ones():
    with pytest.raises(ConfigError, match="hdl-64e"):
        map_geometry("hdl-46e")


@pytest.mark.parametrize("limits", [(-3.0, 3.0, 52, 720), (3.0, 3.0, 52, 720), (3.0, -23.0, 0, 720), (95.0, 0.0, 9, 9)])
def test_invalid_limits_are_errors(limits):
    with pytest.raises(ConfigError):
        MapGeometry(*limits)


@pytest.mark.parametrize(
    ("azimuth_deg", "elevation_deg", "row", "column"),
    [
        (0.0, 0.0, 6, 360),  # straight ahead: (180-0)/0.5, (3-0)/0.5
        (90.1, 0.1, 5, 179),  # left
        (-89.9, -0.1, 6, 539),  # right
        (179.9, 2.9, 0, 0),  # behind on the left: first column
        (-179.9, -22.9, 51, 719),  # behind on the right: last column
        (45.1, -10.1, 26, 269),
    ],
)
def test_a_point_falls_into_the_cell_computed_by_hand(azimuth_deg, elevation_deg, row, column):
    a, e = np.radians([azimuth_deg, elevation_deg])
    point = 12.0 * np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    assert np.argwhere(winner_map(point[None], PAPER) == 0).tolist() == [[row, column]]


def test_a_point_straight_behind_falls_into_the_first_column_from_either_side():
    for y in (0.0, -0.0, 1e-12, -1e-12):
        column = np.argwhere(winner_map([[-10.0, y, 0.0]], PAPER) == 0)[0, 1]
        assert column == 0 or (column == 719 and y < 0)


def test_the_nearest_point_wins_a_cell_and_the_first_of_equals():
    ahead = np.array([1.0, 0.001, -0.01])
    points = np.array([30 * ahead, 10 * ahead, 20 * ahead, 10 * ahead])
    winners = winner_map(points, PAPER)
    assert winners[winners >= 0].tolist() == [1]
    assert np.allclose(vertex_map(points, PAPER)[:, winners == 1][:, 0], 10 * ahead)


def test_a_point_at_the_centre_of_a_cell_falls_into_that_cell():
    points = (rays(PAPER) * 15.0).reshape(-1, 3)
    assert (winner_map(points, PAPER).ravel() == np.arange(PAPER.rows * PAPER.columns)).all()


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_order_of_the_points_does_not_matter(seed):
    points = cloud(seed % 1000)
    shuffled = np.random.default_rng(seed).permutation(points)
    assert np.array_equal(vertex_map(points, PAPER), vertex_map(shuffled, PAPER))


@pytest.mark.parametrize("columns", [1, 7, 360, 719])
def test_turning_the_cloud_by_whole_columns_rolls_both_maps(columns):
    points = (rays(PAPER) * (10.0 + 5.0 * np.sin(3 * np.linspace(0, 2 * np.pi, 720)))[None, :, None]).reshape(-1, 3)
    R = se3.so3_exp([0.0, 0.0, np.radians(-columns * PAPER.column_deg)])
    before, after = vertex_map(points, PAPER), vertex_map(points @ R.T, PAPER)
    turn = np.einsum("ij,jhw->ihw", R, np.roll(before, columns, axis=2))
    assert np.abs(after - turn).max() < 1e-5
    rolled = np.einsum("ij,jhw->ihw", R, np.roll(normal_map(before), columns, axis=2))
    assert np.abs(normal_map(after) - rolled).max() < 1e-3


def test_gathered_values_are_in_the_cells_of_their_points():
    points = cloud(0)
    winners = winner_map(points, PAPER)
    intensity = gather(np.arange(1, len(points) + 1, dtype=np.float32)[:, None], winners)
    assert np.array_equal(intensity[0].astype(int) - 1, winners)


@pytest.mark.parametrize("points", [np.empty((0, 3)), [[np.nan, 1, 1]], [[np.inf, 0, 0]], [[0, 0, 0]], [[5, 0, 50]]])
def test_points_without_a_direction_or_outside_the_rows_leave_the_map_empty(points):
    vertices = vertex_map(points, PAPER)
    assert vertices.shape == (3, 52, 720)
    assert not vertices.any()
    assert not normal_map(vertices).any()


def test_all_points_in_one_place_fill_one_cell_and_give_no_normal():
    vertices = vertex_map(np.full((1000, 3), [7.0, 3.0, -1.0]), PAPER)
    assert valid_cells(vertices).sum() == 1
    assert not normal_map(vertices).any()


def test_normals_of_a_flat_road_point_straight_up_to_the_sensor():
    directions = rays(PAPER)[8:]  # more than a degree below the horizon
    road = directions * (-1.7 / directions[..., 2:])
    vertices = np.zeros((3, 52, 720), np.float32)
    vertices[:, 8:] = np.moveaxis(road, -1, 0)
    normals = normal_map(vertices)
    assert valid_cells(normals)[9:-1].all()
    assert np.abs(normals[:, 9:-1] - np.array([0, 0, 1])[:, None, None]).max() < 1e-3


def test_normals_inside_a_cylinder_point_to_its_axis_also_across_the_seam():
    directions = rays(PAPER)
    wall = directions * (20.0 / np.linalg.norm(directions[..., :2], axis=-1, keepdims=True))
    normals = normal_map(np.moveaxis(wall, -1, 0).astype(np.float32))
    expected = -np.moveaxis(wall * [1, 1, 0] / 20.0, -1, 0)
    assert np.abs(normals[:, 1:-1] - expected[:, 1:-1]).max() < 1e-3


def test_normals_inside_a_sphere_point_to_its_centre():
    sphere = np.moveaxis(rays(PAPER) * 30.0, -1, 0).astype(np.float32)
    assert np.abs(normal_map(sphere)[:, 1:-1] + sphere[:, 1:-1] / 30.0).max() < 1e-2


def test_normals_follow_the_papers_sum_of_weighted_cross_products():
    rng = np.random.default_rng(3)
    depth = rng.uniform(5, 15, (52, 720, 1))
    vertices = np.moveaxis(rays(PAPER) * depth, -1, 0).astype(np.float32)
    normals = normal_map(vertices)
    v = np.moveaxis(vertices, 0, -1).astype(np.float64)
    for row, column in [(1, 0), (25, 719), (50, 300), (17, 401)]:
        p = v[row, column]
        around = [v[row - 1, column], v[row, (column + 1) % 720], v[row + 1, column], v[row, column - 1]]
        weighted = [np.exp(-0.5 * abs(np.linalg.norm(q) - np.linalg.norm(p))) * (q - p) for q in around]
        n = sum(np.cross(weighted[i], weighted[(i + 1) % 4]) for i in range(4))
        n *= -np.sign(n @ p) / np.linalg.norm(n)
        assert normals[:, row, column] == pytest.approx(n, abs=1e-4)


def test_a_cell_with_an_empty_neighbour_and_the_outer_rows_have_no_normal():
    vertices = np.moveaxis(rays(PAPER) * 10.0, -1, 0).astype(np.float32)
    vertices[:, 20, 0] = 0.0
    lost = ~valid_cells(normal_map(vertices))
    expected = np.zeros((52, 720), bool)
    expected[[0, -1]] = True
    expected[[20, 19, 21, 20, 20], [0, 0, 0, 1, 719]] = True
    assert np.array_equal(lost, expected)


def test_every_normal_has_length_one_and_faces_the_sensor():
    depth = np.random.default_rng(5).uniform(5, 15, (52, 720, 1))
    vertices = np.moveaxis(rays(PAPER) * depth, -1, 0).astype(np.float32)
    normals = normal_map(vertices)
    there = valid_cells(normals)
    assert there.sum() == 50 * 720
    assert np.abs(np.linalg.norm(normals[:, there], axis=0) - 1).max() < 1e-5
    assert (np.einsum("ij,ij->j", normals[:, there], vertices[:, there]) <= 1e-4).all()


def test_remapping_by_the_identity_changes_nothing():
    vertices = vertex_map(cloud(1), PAPER)
    normals = normal_map(vertices)
    again, again_normals = remap(vertices, normals, np.eye(4), PAPER)
    assert np.array_equal(again, vertices)
    assert np.array_equal(again_normals, normals)


def test_remapping_moves_vertices_by_the_pose_and_turns_normals_with_them():
    directions = rays(PAPER)
    wall = directions * (20.0 / np.linalg.norm(directions[..., :2], axis=-1, keepdims=True))
    wall = np.moveaxis(wall, -1, 0).astype(np.float32)
    T = se3.exp([0.0, 0.0, 0.3, 0.5, -0.2, 0.1])
    vertices, normals = remap(wall, normal_map(wall), T, PAPER)
    there = valid_cells(normals)
    back = se3.transform(se3.inverse(T), vertices[:, there].T)
    assert np.abs(np.linalg.norm(back[:, :2], axis=1) - 20.0).max() < 1e-4  # still on the cylinder
    outwards = T[:3, :3] @ np.column_stack([back[:, :2] / 20.0, np.zeros(len(back))]).T
    assert np.abs(normals[:, there] + outwards).max() < 1e-3
    expected = vertex_map(se3.transform(T, wall.reshape(3, -1).T), PAPER)
    assert np.array_equal(vertices, expected)
