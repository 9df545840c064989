import numpy as np
import pytest
import torch

from hybridlio.cloud import projection
from hybridlio.cloud.map_geometry import MAP_GEOMETRIES, MapGeometry
from hybridlio.core import se3 as reference
from hybridlio.learned.networks import maps
from hybridlio.learned.networks import torch_se3 as se3

SMALL = MapGeometry(15.0, -25.0, 20, 90)
PAPER = MAP_GEOMETRIES["hdl-64e"]


def clouds(count: int = 6000, batch: int = 2, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return (rng.normal(size=(batch, count, 3)) * [15.0, 15.0, 2.0]).astype(np.float32)


def differing(ours: torch.Tensor, theirs: list[np.ndarray]) -> float:
    """Return the share of cells that differ by more than float32 rounding."""
    apart = ~np.isclose(ours.detach().numpy(), np.stack(theirs), atol=2e-4).all(axis=1)
    return float(apart.mean())


@pytest.mark.parametrize("geometry", [SMALL, PAPER])
def test_vertex_maps_have_the_cells_of_the_numpy_leaf(geometry):
    points = clouds()
    ours = maps.vertex_map(torch.tensor(points), geometry)
    # rounding of an arc sine may move a point across a border: about one cell in ten thousand
    assert differing(ours, [projection.vertex_map(cloud, geometry) for cloud in points]) < 2e-4
    assert maps.valid_cells(ours).float().mean() > 0.05


def test_invalid_points_fall_into_no_cell():
    points = torch.tensor([[[0, 0, 0], [np.nan, 1, 1], [np.inf, 0, 0], [0, 0, 50], [10, 0, 0]]], dtype=torch.float32)
    chosen = maps.winners(points, SMALL)
    assert chosen[chosen >= 0].tolist() == [4]


def test_the_nearest_point_wins_a_cell_and_the_first_among_equals():
    points = torch.tensor([[[9.0, 0, 0], [3.0, 0, 0], [3.0, 0, 0], [5.0, 0, 0]]])
    chosen = maps.winners(points, SMALL)
    assert chosen[chosen >= 0].tolist() == [1]


def box_maps(batch: int) -> torch.Tensor:
    """Vertex maps of the inside of a box, every cell filled."""
    elevation = np.radians(SMALL.fov_up_deg - (np.arange(SMALL.rows) + 0.5) * SMALL.row_deg)[:, None]
    azimuth = np.radians(180 - (np.arange(SMALL.columns) + 0.5) * SMALL.column_deg)[None]
    rays = np.stack(
        np.broadcast_arrays(np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation))
    )
    half = np.random.default_rng(2).uniform(4.0, 9.0, size=(batch, 3, 1, 1))
    return torch.tensor(rays / np.abs(rays / half).max(axis=1, keepdims=True), dtype=torch.float32)


def test_normal_maps_are_those_of_the_numpy_leaf():
    vertices = box_maps(2)
    vertices[:, :, 7, 30] = 0.0
    theirs = np.stack([projection.normal_map(v) for v in vertices.numpy()])
    assert np.allclose(maps.normal_map(vertices).numpy(), theirs, atol=1e-4)
    assert np.abs(theirs).sum() > 0


def test_maps_move_as_in_the_numpy_leaf():
    vertices = box_maps(2)
    normals = maps.normal_map(vertices)
    T = reference.exp(np.array([[0.01, -0.02, 0.1, 0.8, -0.2, 0.1], [0.0, 0.0, -0.03, -0.5, 0.3, 0.0]]))
    moved, rotated = maps.remap(vertices, normals, torch.tensor(T, dtype=torch.float32), SMALL)
    pairs = [projection.remap(v.numpy(), n.numpy(), t, SMALL) for v, n, t in zip(vertices, normals, T, strict=True)]
    assert differing(moved, [pair[0] for pair in pairs]) < 2e-3
    assert differing(rotated, [pair[1] for pair in pairs]) < 2e-3


def test_moving_by_the_identity_leaves_a_map_as_it_is():
    vertices = box_maps(1)
    moved, _ = maps.remap(vertices, maps.normal_map(vertices), se3.identity(1, vertices), SMALL)
    assert torch.equal(moved, vertices)


def test_the_gradient_of_a_moved_map_is_that_of_its_points():
    vertices = box_maps(1)
    t = torch.tensor([[0.3, -0.1, 0.05]], requires_grad=True)
    T = se3.make(torch.eye(3)[None], t)
    moved, _ = maps.remap(vertices, maps.normal_map(vertices), T, SMALL)
    moved[:, 0].sum().backward()
    assert t.grad is not None
    # every cell that shows a point moves along x as much as the pose does
    assert t.grad[0].tolist() == [float(maps.valid_cells(moved).sum()), 0.0, 0.0]
