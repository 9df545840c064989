"""Steps of point-to-plane registration between two maps, with weights that a small network gives.

Not in the paper. Cells are the matches: each point of the current scan, moved by the pose so far, is held against the
plane of the last scan in the cell that it falls into, and one weighted Gauss-Newton step of the point-to-plane loss is
solved in closed form. The steps are differentiable, so the unsupervised loss teaches the weights which points to trust
(moving cars, edges, leaves): both scans go through the same convolutions once, and a point's weight is a small network
of the features of both its cells, of how rough they are and of its distance. Untrained, all points count alike but for
a robust kernel.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from hybridlio.learned import maps, se3
from hybridlio.learned.residual_network import CircularConv
from hybridlio.learned.settings import NetworkSettings
from hybridlio.projection import MapGeometry

_KERNEL_M = 0.3
_LEVER_M = 10.0  # rotations are measured at this lever, so that the system is well scaled
_DAMPING = 5e-4  # of the normal equations a point: directions that hardly any cell constrains stay as they are
_LIMIT_M = 1.0
_DISTANCE_M = 0.1  # what is left after an initial pose, so that networks see numbers around 1
_COARSE = 2  # features have a cell for so many rows and columns of the maps

Maps = tuple[Tensor, Tensor]


class ProjectiveSteps(nn.Module):
    """From two pairs of maps and a pose to better poses, one for each step."""

    def __init__(self, settings: NetworkSettings) -> None:
        super().__init__()
        self.settings = settings
        self.log_kernel = nn.Parameter(torch.full((settings.projective_steps,), math.log(_KERNEL_M)))
        self.weights = PointWeights(settings) if settings.weight_channels else None

    def forward(self, last: Maps, current: Maps, pose: Tensor) -> list[Tensor]:
        """Poses ``T_k_k1`` ``(B, 4, 4)`` after each step.

        A step takes the pose before it as given: gradients go through the weights, not back through earlier steps.

        Args:
            last: vertex and normal maps ``(B, 3, H, W)`` of the last scan.
            current: those of the current scan, in its own frame.
            pose: ``(B, 4, 4)`` to start from.
        """
        planes = _planes(*last)
        points, seen = current[0].flatten(2), maps.valid_cells(current[0]).flatten(1)[:, None]
        logits = None if self.weights is None else self.weights(last, current)
        poses = []
        for kernel_m in self.log_kernel.exp():
            pose = pose.detach()
            moved = pose[:, :3, :3] @ points + pose[:, :3, 3:]
            cell, inside = maps.cells(moved, self.settings.geometry)
            normals, distance, there = _held_against(planes, moved, cell, inside[:, None] & seen)
            weights = there * (kernel_m**2 / (kernel_m**2 + distance.square())).square()
            if logits is not None:
                weights = weights * torch.sigmoid(logits(cell, distance))
            pose = weighted_step(normals, moved, distance, weights) @ pose
            poses.append(pose)
        return poses


class PointWeights(nn.Module):
    """What each point of the current map counts, by the features of its cell in both maps and its distance."""

    def __init__(self, settings: NetworkSettings) -> None:
        super().__init__()
        self.scale_m, self.geometry = settings.vertex_scale_m, settings.geometry
        channels = settings.weight_channels
        self.features = nn.Sequential(
            CircularConv(8, channels, 3, (_COARSE, _COARSE), bias=True),
            nn.ReLU(),
            CircularConv(channels, channels, 3, (1, 1), bias=True),
            nn.ReLU(),
            CircularConv(channels, channels, 3, (1, 1), bias=True),
            nn.ReLU(),
        )
        self.of_last = nn.Conv2d(channels, channels, 1)
        self.of_current = nn.Conv2d(channels, channels, 1, bias=False)
        self.of_point = nn.Conv1d(3, channels, 1, bias=False)
        self.logit = nn.Conv1d(channels, 1, 1)
        for parameter in self.logit.parameters():
            nn.init.zeros_(parameter)

    def forward(self, last: Maps, current: Maps) -> _Logits:
        """The weights' logits, as a function of the cells that points fall into and their distances there."""
        rough = [_roughness(*both) for both in (last, current)]
        seen = [
            torch.cat([v / self.scale_m, n, r, (v != 0).any(1, keepdim=True)], dim=1)
            for (v, n), r in zip((last, current), rough, strict=True)
        ]
        of_last, of_current = self.features(torch.cat(seen)).chunk(2)
        coarse = _coarse_cells(self.geometry, of_last.device)
        own = self.of_current(of_current).flatten(2)[..., coarse]
        return _Logits(self, self.of_last(of_last).flatten(2), own, coarse, rough[0].flatten(2), rough[1].flatten(2))


class _Logits:
    """Logits ``(B, 1, N)`` of points by the flat cells ``(B, N)`` they fall into and their distances ``(B, 1, N)``."""

    def __init__(
        self, net: PointWeights, of_last: Tensor, own: Tensor, coarse: Tensor, rough_last: Tensor, rough_own: Tensor
    ) -> None:
        self.net, self.of_last, self.own, self.coarse = net, of_last, own, coarse
        self.rough_last, self.rough_own = rough_last, rough_own

    def __call__(self, cell: Tensor, distance: Tensor) -> Tensor:
        there = self.coarse[cell][:, None].expand(-1, self.of_last.shape[1], -1)
        size = distance.abs().detach() / _DISTANCE_M
        point = torch.cat([size, self.rough_last.gather(2, cell[:, None]), self.rough_own], dim=1)
        hidden = torch.relu(self.of_last.gather(2, there) + self.own + self.net.of_point(point))
        return self.net.logit(hidden)  # type: ignore[no-any-return]


def _roughness(vertices: Tensor, normals: Tensor) -> Tensor:
    """``(B, 1, H, W)`` how far cells lie from between their neighbours along their normals, in units of 0.1 m, up to 5.

    0 where there is no normal. On a plane it is the noise of the range.
    """
    around = functional.pad(vertices, (1, 1, 0, 0), mode="circular")
    beside = (around[..., 2:] + around[..., :-2]) / 2 - vertices
    above = torch.zeros_like(vertices)
    above[..., 1:-1, :] = (vertices[..., 2:, :] + vertices[..., :-2, :]) / 2 - vertices[..., 1:-1, :]
    off = [(normals * offset).sum(dim=1, keepdim=True).abs() for offset in (beside, above)]
    return (torch.maximum(*off) / _DISTANCE_M).clamp(max=5.0)


def _coarse_cells(geometry: MapGeometry, device: torch.device) -> Tensor:
    """For each cell of the maps the flat cell of the features ``(H·W,)``."""
    rows = torch.arange(geometry.rows, device=device) // _COARSE
    columns = torch.arange(geometry.columns, device=device) // _COARSE
    return (rows[:, None] * math.ceil(geometry.columns / _COARSE) + columns).flatten()


def _planes(vertices: Tensor, normals: Tensor) -> Tensor:
    """``(B, 4, H·W)``: the normal n of each cell, and n·v; 0 where it has no plane."""
    return torch.cat([normals, (normals * vertices).sum(dim=1, keepdim=True)], dim=1).flatten(2)


def _held_against(planes: Tensor, points: Tensor, cell: Tensor, known: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Normals ``(B, 3, N)``, signed distances ``(B, 1, N)`` in metres, and where there are such, as 0 and 1.

    Args:
        planes: of :func:`_planes`.
        points: ``(B, 3, N)`` in the planes' frame.
        cell: ``(B, N)`` they fall into.
        known: ``(B, 1, N)`` which of them are points at all.
    """
    chosen = planes.gather(2, cell[:, None].expand(-1, 4, -1))
    normals = chosen[:, :3]
    distance = (normals * points).sum(dim=1, keepdim=True) - chosen[:, 3:]
    there = known & (distance.abs() < _LIMIT_M) & (normals != 0).any(dim=1, keepdim=True)
    return normals, torch.where(there, distance, 0.0), there.to(distance.dtype)


def weighted_step(normals: Tensor, points: Tensor, distance: Tensor, weights: Tensor) -> Tensor:
    """``δT`` ``(B, 4, 4)`` of one Gauss-Newton step of ``Σ w d²``, for points and the planes that they belong to.

    Args:
        normals, points: ``(B, 3, N)`` in one frame.
        distance, weights: ``(B, 1, N)``.
    """
    # d of Exp(ξ)·p is n·(ω × p + v) = (p × n)·ω + n·v
    J = torch.cat([maps.cross(points, normals, dim=1) / _LEVER_M, normals], dim=1)
    weighted = J * weights
    total = weights.sum(-1, keepdim=True).clamp(min=1e-6)
    H = weighted @ J.transpose(1, 2) / total
    g = weighted @ distance.transpose(1, 2) / total
    eye = torch.eye(6, dtype=H.dtype, device=H.device)
    xi = -torch.linalg.solve(H + _DAMPING * eye, g)[..., 0]
    return se3.exp(torch.cat([xi[:, :3] / _LEVER_M, xi[:, 3:]], dim=1))
