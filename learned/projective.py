"""A step of point-to-plane registration between two maps, cell by cell, with weights that a small network gives.

Not in the paper. Cells are the matches: each point of the current scan, moved by the pose so far, is held against the
plane of the last scan in its cell, and one weighted Gauss-Newton step of the point-to-plane loss is solved in closed
form. The step is differentiable, so the unsupervised loss teaches the weights which cells to trust (moving cars, edges,
leaves). Untrained, all cells count alike but for a robust kernel.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from hybridlio.learned import maps, se3
from hybridlio.learned.residual_network import CircularConv
from hybridlio.learned.settings import NetworkSettings

_KERNEL_M = 0.3
_LEVER_M = 10.0  # rotations are measured at this lever, so that the system is well scaled
_DAMPING = 5e-4  # of the normal equations a point: directions that hardly any cell constrains stay as they are
_LIMIT_M = 1.0


class ProjectiveStep(nn.Module):
    """Weights for the cells, and the residual that they give."""

    def __init__(self, settings: NetworkSettings) -> None:
        super().__init__()
        self.scale_m = settings.vertex_scale_m
        channels = settings.weight_channels
        self.layers = nn.Sequential(
            CircularConv(14, channels, 3, (1, 1), bias=True),
            nn.ReLU(),
            CircularConv(channels, channels, 3, (1, 1), bias=True),
            nn.ReLU(),
        )
        self.logit = nn.Conv2d(channels, 1, 1)
        for parameter in self.logit.parameters():
            nn.init.zeros_(parameter)

    def forward(self, last: tuple[Tensor, Tensor], current: tuple[Tensor, Tensor]) -> Tensor:
        """``δT`` ``(B, 4, 4)`` that lays the current maps on the last ones; arguments as the residual network's."""
        distance, there = plane_distance(last, current[0])
        robust = (_KERNEL_M**2 / (_KERNEL_M**2 + distance.square())).square()
        weights = torch.sigmoid(self.logit(self.layers(self._inputs(last, current, distance, there))))
        return weighted_step(last[1], current[0], distance, weights * robust * there)

    def _inputs(
        self, last: tuple[Tensor, Tensor], current: tuple[Tensor, Tensor], distance: Tensor, there: Tensor
    ) -> Tensor:
        vertices = [last[0] / self.scale_m, current[0] / self.scale_m]
        return torch.cat([*vertices, last[1], current[1], distance / 0.1, there], dim=1)


def plane_distance(last: tuple[Tensor, Tensor], vertices: Tensor) -> tuple[Tensor, Tensor]:
    """Signed distance ``(B, 1, H, W)`` in metres of vertices to the last scan's planes in their cells, and where it is.

    It is 0 where either lacks, or where it exceeds 1 m.
    """
    distance = (last[1] * (vertices - last[0])).sum(dim=1, keepdim=True)
    there = maps.valid_cells(vertices) & maps.valid_cells(last[1])
    near = there[:, None] & (distance.abs() < _LIMIT_M)
    return torch.where(near, distance, 0.0), near.to(distance.dtype)


def weighted_step(normals: Tensor, vertices: Tensor, distance: Tensor, weights: Tensor) -> Tensor:
    """``δT`` ``(B, 4, 4)`` of one Gauss-Newton step of ``Σ w d²``, for moved vertices and planes of the same cells.

    Args:
        normals, vertices: ``(B, 3, H, W)`` in one frame.
        distance, weights: ``(B, 1, H, W)``.
    """
    # d of Exp(ξ)·p is n·(ω × p + v) = (p × n)·ω + n·v
    J = torch.cat([torch.linalg.cross(vertices, normals, dim=1) / _LEVER_M, normals], dim=1).flatten(2)
    w, d = weights.flatten(2), distance.flatten(2)
    total = w.sum(-1, keepdim=True).clamp(min=1e-6)
    H = (J * w) @ J.transpose(1, 2) / total
    g = (J * w) @ d.transpose(1, 2) / total
    eye = torch.eye(6, dtype=H.dtype, device=H.device)
    xi = -torch.linalg.solve(H + _DAMPING * eye, g)[..., 0]
    return se3.exp(torch.cat([xi[:, :3] / _LEVER_M, xi[:, 3:]], dim=1))
