"""Vertex and normal maps in PyTorch: batched, on any device, with gradients through the contents of cells.

The same cells as :mod:`hybridlio.cloud.projection` (UnDeepLIO, "Vertex map", "Normal map", "Mapping the point clouds of
current frame to the last frame"). The choice of a cell's point has no gradient; its coordinates have one, so the loss
reaches the pose that moved a map. Geometry stays in single precision also where encoders compute in bfloat16.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

from hybridlio.cloud.map_geometry import MapGeometry
from hybridlio.learned.networks import torch_se3 as se3

_FAR = (1 << 63) - 1  # largest int64: the key of an empty cell
_INDEX_BITS = 32  # low half of an int64 key; the high half holds the bits of a float32 depth
_DEG = 180.0 / math.pi


@torch.no_grad()
def cells(points: Tensor, geometry: MapGeometry) -> tuple[Tensor, Tensor]:
    """Return the flat cells ``(B, N)`` int64 of points ``(B, 3, N)``, and whether they lie in the map ``(B, N)``.

    Points that are not finite, at the origin or outside the rows do not; their cell is 0.
    """
    x, y, z = points.unbind(1)
    depth = (x * x + y * y + z * z).sqrt()
    row = (geometry.fov_up_deg - _DEG * torch.asin(z / depth)) / geometry.row_deg
    column = (180.0 - _DEG * torch.atan2(y, x)) / geometry.column_deg
    inside = (row >= 0) & (row < geometry.rows) & (depth < torch.inf)  # NaN compares false
    flat = row.long() * geometry.columns + column.long() % geometry.columns
    return torch.where(inside, flat, 0), inside


@torch.no_grad()
def winners(points: Tensor, geometry: MapGeometry) -> Tensor:
    """Return the index of the nearest point in each cell ``(B, H·W)`` int64, −1 for empty cells.

    Args:
        points: ``(B, N, 3)`` float32 metres. Points that are not finite, at the origin or outside the rows are left
            out. Of equally near points the first wins.
        geometry: the cells.
    """
    batch, count, _ = points.shape
    number = geometry.rows * geometry.columns
    cell, inside = cells(points.float().transpose(1, 2), geometry)
    depth = points.float().square().sum(-1).sqrt()
    index = torch.arange(count, device=points.device)
    # positive floats sort like their bits, so the minimum of (depth, index) packed into an integer is the nearest point
    key = (depth.view(torch.int32).long() << _INDEX_BITS) | index
    cell = torch.where(inside, cell, number)  # an extra cell, dropped below, takes points outside
    nearest = torch.full((batch, number + 1), _FAR, dtype=torch.int64, device=points.device)
    nearest.scatter_reduce_(1, cell, key, reduce="amin")
    nearest = nearest[:, :number]
    return torch.where(nearest == _FAR, -1, nearest & ((1 << _INDEX_BITS) - 1))


def gather(values: Tensor, chosen: Tensor, geometry: MapGeometry) -> Tensor:
    """Values ``(B, N, C)`` of the points, as maps ``(B, C, H, W)`` by :func:`winners`; 0 in empty cells."""
    index = chosen.clamp(min=0)[..., None].expand(-1, -1, values.shape[-1])
    there = (chosen >= 0)[..., None]
    filled = torch.where(there, values.gather(1, index), torch.zeros((), dtype=values.dtype, device=values.device))
    return filled.transpose(1, 2).reshape(len(values), values.shape[-1], geometry.rows, geometry.columns)


def vertex_map(points: Tensor, geometry: MapGeometry) -> Tensor:
    """Return vertex maps ``(B, 3, H, W)`` of points ``(B, N, 3)`` in metres: the nearest point of each cell, or 0.

    Pad clouds of different sizes with zeros: a point at the origin falls into no cell.
    """
    return gather(points, winners(points, geometry), geometry)


def valid_cells(maps: Tensor) -> Tensor:
    """Return which cells ``(B, H, W)`` of maps ``(B, C, H, W)`` are not empty."""
    first, *others = maps.unbind(-3)
    found = first != 0
    for channel in others:  # twice as fast as any() along them
        found = found | (channel != 0)
    return found


def as_points(maps: Tensor) -> Tensor:
    """Return the cells of maps ``(B, 3, H, W)`` as a list ``(B, H·W, 3)``, row by row."""
    return maps.flatten(2).transpose(1, 2)


def normal_map(vertices: Tensor) -> Tensor:
    """Return normal maps ``(B, 3, H, W)`` of vertex maps: unit normals towards the sensor, 0 without all neighbours.

    The definition is that of :func:`hybridlio.cloud.projection.normal_map`.
    """
    depth = vertices.square().sum(-3, keepdim=True).sqrt()
    around = torch.cat([vertices, depth], dim=-3)
    # weighted difference to the next cell; for that cell it is the negative difference to this one
    to_right = _weighted(torch.roll(around, -1, dims=-1) - around)
    to_below = _weighted(around[..., 1:, :] - around[..., :-1, :])
    there = depth[..., 0, :, :] > 0
    beside = torch.roll(there, 1, dims=-1) & torch.roll(there, -1, dims=-1)
    valid = functional.pad(there[..., 2:, :] & there[..., :-2, :], (0, 0, 1, 1)) & beside & there
    upwards = functional.pad(-to_below[..., :-1, :] - to_below[..., 1:, :], (0, 0, 1, 1))
    # sum of the four cyclic cross products, as one
    total = cross(upwards, to_right + torch.roll(to_right, 1, dims=-1), dim=-3)
    length = total.square().sum(-3).sqrt()
    valid = valid & (length > 0)
    size = torch.where(valid, length, 1.0)
    signed = torch.where((total * vertices).sum(-3) > 0, -size, size)
    return torch.where(valid[..., None, :, :], total / signed[..., None, :, :], 0.0)


def _weighted(difference: Tensor) -> Tensor:
    """Weight differences ``(..., 3, H, W)`` of vertices by the difference of their ranges, the fourth channel."""
    return torch.exp(-0.5 * difference[..., 3:, :, :].abs()) * difference[..., :3, :, :]


def cross(a: Tensor, b: Tensor, dim: int) -> Tensor:
    """Return cross products along a dimension of size 3; on a CPU several times as fast as PyTorch's."""
    (ax, ay, az), (bx, by, bz) = a.unbind(dim), b.unbind(dim)
    return torch.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], dim=dim)


def remap(vertices: Tensor, normals: Tensor, T_a_b: Tensor, geometry: MapGeometry) -> tuple[Tensor, Tensor]:
    """Project the maps of frame b into frame a: vertices are moved and projected again, normals rotated with them.

    Gradients reach ``T_a_b`` through the moved vertices and rotated normals.

    Args:
        vertices, normals: ``(B, 3, H, W)`` in frame b.
        T_a_b: ``(B, 4, 4)``, such as the initial poses ``T_k_k1``.
        geometry: the cells of the result.
    """
    there = valid_cells(vertices).flatten(1)[..., None]
    moved = torch.where(there, se3.transform(T_a_b, as_points(vertices)), 0.0)  # empty cells stay at the origin
    chosen = winners(moved, geometry)
    rotated = se3.rotate(T_a_b, as_points(normals))
    return gather(moved, chosen, geometry), gather(rotated, chosen, geometry)
