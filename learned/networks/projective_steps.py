"""Point-to-plane registration steps between two maps, with point weights from a small network.

Not in the paper. Each point of the current scan, moved by the pose so far, is matched to the plane of the last scan in
the cell that it falls into (projective association). One weighted Gauss-Newton step of the point-to-plane cost follows,
in closed form. The steps are differentiable, so the unsupervised loss trains the weights to reject moving cars, edges
and leaves. Both scans pass the same convolutions once; a small network computes a point's weight from the features and
roughness of both cells and from its distance. Before training, all points have the weight of the robust kernel only.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor, nn
from torch.nn import functional

from hybridlio.cloud.map_geometry import MapGeometry
from hybridlio.learned.networks import maps
from hybridlio.learned.networks import torch_se3 as se3
from hybridlio.learned.networks.layers import CircularConv
from hybridlio.learned.networks.network_types import ProjectiveScan
from hybridlio.learned.settings import NetworkSettings

# Widths of the robust kernel in the first and the last step, before training: above the error of an initial pose
# (0.15 m), and twice a lidar's range noise.
_KERNELS_M = (0.4, 0.05)
_KERNEL_GAIN = 10.0  # Adam moves this one parameter as slowly as a layer's weights; the gain lets widths follow
_LEVER_M = 10.0  # lever arm for rotations, so that the normal equations are well scaled; the median range on a road
_DAMPING = 1e-4  # of the normal equations, divided by the weight: keeps directions that hardly any cell constrains
_LIMIT_M = 1.0  # farther from its plane a point belongs to another surface; several times an initial pose's error
_DISTANCE_M = 0.1  # unit of distances: about the error of an initial pose, so that inputs are about 1
_FEWEST = 9000  # maps with fewer points are not thinned: a quarter of a map of 52 x 720
_ONE_OF = (4, 2)  # in the first half of the steps every fourth point, later every second: more do not gain accuracy
_DILATION = 3  # of the last convolution, so that features see about 10° around
_COARSE = 2  # rows and columns of the maps in a cell of the features, for a quarter of the time


class ProjectiveSteps(nn.Module):
    """Refines a pose between two scans, step by step."""

    def __init__(self, settings: NetworkSettings) -> None:
        super().__init__()
        self.settings = settings
        self.log_kernel = nn.Parameter(torch.zeros(settings.projective_steps))
        first, last = map(math.log, _KERNELS_M)
        self.register_buffer("_start", torch.linspace(first, last, settings.projective_steps), persistent=False)
        self.weights = PointWeights(settings) if settings.weight_channels else None

    def encode(self, vertices: Tensor, normals: Tensor) -> ProjectiveScan:
        """Return the inputs of the steps from a scan's maps ``(B, 3, H, W)`` in its own frame."""
        offset = (normals * vertices).sum(dim=1, keepdim=True)
        offset = torch.where(maps.valid_cells(normals)[:, None], offset, torch.inf)
        planes = torch.cat([normals, offset], dim=1).flatten(2)
        seen = maps.valid_cells(vertices)[:, None]
        points = ProjectiveScan(vertices.flatten(2), seen.flatten(2), planes)
        if self.weights is None:
            return points
        rough = _roughness(vertices, normals)
        as_last, as_current = self.weights.encode(vertices, normals, rough, seen)
        coarse = self.weights.coarse
        return replace(points, rough=rough.flatten(2), as_last=as_last, as_current=as_current, coarse=coarse)

    def forward(self, last: ProjectiveScan, current: ProjectiveScan, pose: Tensor) -> list[Tensor]:
        """Return poses ``T_k_k1`` ``(B, 4, 4)`` after each step.

        No gradient goes back through earlier steps: each step is differentiable by its weights only.
        """
        most = max(current.points.shape[-1] // _FEWEST, 1)
        few, more = (_thinned(current, min(by, most)) for by in _ONE_OF)
        poses = []
        for k, kernel_m in enumerate(self.kernels_m):
            points = few if k < self.settings.projective_steps // 2 else more
            pose = self._step(last, points, pose.detach(), kernel_m) @ pose.detach()
            poses.append(pose)
        return poses

    def _step(self, last: ProjectiveScan, current: ProjectiveScan, pose: Tensor, kernel_m: Tensor) -> Tensor:
        """Return ``δT`` ``(B, 4, 4)`` of one step."""
        moved = torch.baddbmm(pose[:, :3, 3:], pose[:, :3, :3], current.points)
        cell, inside = maps.cells(moved, self.settings.geometry)
        normals, distance, there = _point_to_plane(last.planes, moved, cell, inside[:, None] & current.seen)
        weights = there * (kernel_m**2 / (kernel_m**2 + distance.square())).square()
        if self.weights is not None:
            weights = weights * self.weights(last, current, cell, distance, kernel_m)
        return weighted_step(normals, moved, distance, weights)

    @property
    def kernels_m(self) -> Tensor:
        """Width of each step's robust kernel, in metres."""
        start: Tensor = self.get_buffer("_start")
        return (start + _KERNEL_GAIN * self.log_kernel).exp()


class PointWeights(nn.Module):
    """Computes the weight of each point of the current scan from the features of both its cells and its distance."""

    def __init__(self, settings: NetworkSettings) -> None:
        super().__init__()
        self.scale_m = settings.vertex_scale_m
        channels = settings.weight_channels
        self.features = nn.Sequential(
            CircularConv(8, channels, 3, (_COARSE, _COARSE), bias=True),
            nn.ReLU(),
            CircularConv(channels, channels, 3, (1, 1), bias=True),
            nn.ReLU(),
            CircularConv(channels, channels, 3, (1, 1), bias=True, dilation=_DILATION),
            nn.ReLU(),
        )
        self.of_last = nn.Linear(channels, channels)
        self.of_current = nn.Linear(channels, channels, bias=False)
        self.of_point = nn.Linear(4, channels, bias=False)
        self.logit = nn.Linear(channels, 1)
        for parameter in self.logit.parameters():
            nn.init.zeros_(parameter)
        self.register_buffer("_coarse", _coarse_cells(settings.geometry), persistent=False)

    @property
    def coarse(self) -> Tensor:
        """``(H·W,)`` index of the coarse cell that contains each cell of a map."""
        return self.get_buffer("_coarse")

    def encode(self, vertices: Tensor, normals: Tensor, rough: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
        """Return the contributions of a scan's coarse cells ``(B, n, C)``, as the last scan and as the current one."""
        inputs = torch.cat([vertices / self.scale_m, normals, rough, seen.to(vertices.dtype)], dim=1)
        features = self.features(inputs).flatten(2)
        # as convolutions with a copy: several times as fast as linear layers on the transposed features
        as_last = functional.conv1d(features, self.of_last.weight[..., None], self.of_last.bias)
        as_current = functional.conv1d(features, self.of_current.weight[..., None])
        return as_last.transpose(1, 2).contiguous(), as_current.transpose(1, 2).contiguous()

    def forward(
        self, last: ProjectiveScan, current: ProjectiveScan, cell: Tensor, distance: Tensor, kernel_m: Tensor
    ) -> Tensor:
        """Return weights ``(B, 1, N)`` from 0 to 1, from the cells ``(B, N)`` that points fall into and distances."""
        assert last.rough is not None
        assert last.as_last is not None
        assert current.rough is not None
        assert current.as_current is not None
        size = distance.abs()
        compared = (size / kernel_m.detach()).clamp(max=5.0)
        rough = last.rough.gather(2, cell[:, None])
        point = torch.cat([size / _DISTANCE_M, compared, rough, current.rough], dim=1)
        batch, cells, channels = last.as_last.shape
        # gathering rows of a table is faster than gathering from each channel
        first = torch.arange(0, batch * cells, cells, device=cell.device)[:, None]
        fallen_into = (self.coarse.index_select(0, cell.flatten()).reshape(cell.shape) + first).flatten()
        there = last.as_last.reshape(-1, channels).index_select(0, fallen_into).reshape(batch, -1, channels)
        of_point = torch.bmm(self.of_point.weight.expand(batch, -1, -1), point).transpose(1, 2)
        # in place, since memory traffic dominates
        hidden = there.add_(current.as_current).add_(of_point).relu_()
        weights: Tensor = self.logit(hidden)
        return weights.sigmoid_().transpose(1, 2)


def _coarse_cells(geometry: MapGeometry) -> Tensor:
    """Return the index ``(H·W,)`` of the coarse cell that contains each cell, both counted row by row."""
    rows, columns = (torch.arange(n, device="cpu") // _COARSE for n in (geometry.rows, geometry.columns))
    return (rows[:, None] * (int(columns[-1]) + 1) + columns).flatten()


def _thinned(scan: ProjectiveScan, by: int) -> ProjectiveScan:
    """Return the scan with every ``by``-th point; data by cell stay whole."""
    rough, coarse = (None if x is None else x[..., ::by].contiguous() for x in (scan.rough, scan.coarse))
    points, seen = scan.points[..., ::by].contiguous(), scan.seen[..., ::by].contiguous()
    own = scan.as_current
    if own is not None and coarse is not None:
        own = own.index_select(1, coarse)
    return replace(scan, points=points, seen=seen, rough=rough, as_current=own, coarse=coarse)


def _roughness(vertices: Tensor, normals: Tensor) -> Tensor:
    """Return the distance ``(B, 1, H, W)`` of cells from the mean of their neighbours along the normal.

    It is the larger one of both directions, in units of 0.1 m, at most 5, and 0 without a normal. On a plane it is the
    range noise.
    """
    around = functional.pad(vertices, (1, 1, 0, 0), mode="circular")
    beside = (around[..., 2:] + around[..., :-2]) / 2 - vertices
    above = torch.zeros_like(vertices)
    above[..., 1:-1, :] = (vertices[..., 2:, :] + vertices[..., :-2, :]) / 2 - vertices[..., 1:-1, :]
    off = [(normals * offset).sum(dim=1, keepdim=True).abs() for offset in (beside, above)]
    return (torch.maximum(*off) / _DISTANCE_M).clamp(max=5.0)


def _point_to_plane(planes: Tensor, points: Tensor, cell: Tensor, known: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return normals ``(B, 3, N)``, signed distances ``(B, 1, N)`` in metres, and a mask of valid ones (0 or 1).

    Args:
        planes: ``(B, 4, H·W)`` as in :class:`ProjectiveScan`.
        points: ``(B, 3, N)`` in the planes' frame.
        cell: ``(B, N)`` the cell that each point falls into.
        known: ``(B, 1, N)`` true for points inside the map.
    """
    chosen = planes.gather(2, cell[:, None].expand(-1, 4, -1))
    normals = chosen[:, :3]
    distance = (normals * points).sum(dim=1, keepdim=True) - chosen[:, 3:]
    there = known & (distance.abs() < _LIMIT_M)
    return normals, torch.where(there, distance, 0.0), there.to(distance.dtype)


def weighted_step(normals: Tensor, points: Tensor, distance: Tensor, weights: Tensor) -> Tensor:
    """Return ``δT`` ``(B, 4, 4)`` of one Gauss-Newton step of ``Σ w d²`` for points matched to planes.

    Args:
        normals, points: ``(B, 3, N)`` in one frame.
        distance, weights: ``(B, 1, N)``.
    """
    # d of Exp(ξ)·p is n·(ω × p + v) = (p × n)·ω + n·v
    J = torch.cat([maps.cross(points, normals, dim=1), normals], dim=1)
    weighted = J * weights
    total = weights.sum(-1, keepdim=True).clamp(min=1e-6)
    unit = torch.ones(6, 1, dtype=J.dtype, device=J.device)
    unit[:3] /= _LEVER_M
    H = weighted @ J.transpose(1, 2) * (unit * unit.T) / total
    g = weighted @ distance.transpose(1, 2) * unit / total
    eye = torch.eye(6, dtype=H.dtype, device=H.device)
    xi = -torch.linalg.solve(H + _DAMPING * eye, g)[..., 0]
    return se3.exp(torch.cat([xi[:, :3] / _LEVER_M, xi[:, 3:]], dim=1))
