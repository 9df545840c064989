"""The loss of a batch: that of the network's poses, with matches searched at its answer."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from hybridlio.cloud.map_geometry import MapGeometry
from hybridlio.learned.data.pairs import PairBatch
from hybridlio.learned.losses.correspondences import Clouds, Matches, match
from hybridlio.learned.losses.loss import LossValue, gauss_newton, loss
from hybridlio.learned.networks import torch_se3 as se3
from hybridlio.learned.networks.network_types import NetworkOutput
from hybridlio.learned.networks.odometry_network import OdometryNetwork
from hybridlio.learned.settings import LossSettings

_LEVER_M = 10.0  # converts rotations to metres; about the median range of a road scan
_DAMPING = 1e-4  # of a match's curvature: unconstrained directions stay, others hardly change


def clouds_for(batch: PairBatch, settings: LossSettings) -> tuple[Clouds, Clouds]:
    """Return the last and current clouds to match: the whole averaged clouds, or the points of the maps."""
    if settings.matching == "nearest":
        return batch.last, batch.current
    return Clouds.of_maps(batch.network.last), Clouds.of_maps(batch.network.current)


def pose_loss(pose: Tensor, clouds: tuple[Clouds, Clouds], settings: LossSettings, geometry: MapGeometry) -> LossValue:
    """Return the loss of poses ``(B, 4, 4)`` with matches searched there."""
    return loss(match(pose, *clouds, settings, geometry), pose, settings)


def objective(output: NetworkOutput, batch: PairBatch, settings: LossSettings, geometry: MapGeometry) -> LossValue:
    """Return the loss of a batch: the mean over the network's poses, and the initial pose's times its weight."""
    clouds = clouds_for(batch, settings)
    poses = [*output.poses, output.initial] if settings.initial_weight else list(output.poses)
    shares = [1 / len(output.poses)] * len(output.poses) + [settings.initial_weight] * bool(settings.initial_weight)
    matches = match(output.pose, *clouds, settings, geometry) if settings.matched_at == "answer" else None
    if matches is not None:
        values = [loss(matches, pose, settings) for pose in poses]
    else:
        values = [pose_loss(pose, clouds, settings, geometry) for pose in poses]
    costs = [value.total for value in values]
    if settings.target_weight:
        target = descended(output.pose, clouds, settings, geometry, matches)
        costs = [
            cost + settings.target_weight * _apart_m(target, pose) for cost, pose in zip(costs, poses, strict=True)
        ]
    total = torch.stack([share * cost for share, cost in zip(shares, costs, strict=True)]).sum(0)
    answer = values[len(output.poses) - 1]
    return LossValue(total, answer.po2pl_m, answer.pl2pl, answer.matched)


@torch.no_grad()
def descended(
    pose: Tensor,
    clouds: tuple[Clouds, Clouds],
    settings: LossSettings,
    geometry: MapGeometry,
    matches: Matches | None = None,
) -> Tensor:
    """Return poses ``(B, 4, 4)`` after ``target_steps`` Gauss-Newton steps on the loss.

    ``matches`` are those at the start; None searches them. The damping keeps directions that few points constrain.
    """
    lever = torch.tensor([_LEVER_M] * 3 + [1.0] * 3, dtype=pose.dtype, device=pose.device)
    for _ in range(settings.target_steps):
        matches = matches or match(pose, *clouds, settings, geometry)
        near = gauss_newton(matches, pose, settings)
        # curvature of a match without residual, times the number of matches
        scale = _DAMPING * matches.weight.sum(1).clamp(min=1) * settings.alpha / settings.kernel_m
        H = near.hessian + torch.diag(lever.square()) * scale[:, None, None]
        pose = pose @ se3.exp(-torch.linalg.solve(H, near.gradient[..., None])[..., 0])
        matches = None
    return pose


def _apart_m(target: Tensor, pose: Tensor) -> Tensor:
    """Return the distance of poses ``(B,)`` in metres: translation, and rotation at a lever of 10 m."""
    xi = se3.log(se3.inverse(target) @ pose)
    squared = xi[:, 3:].square().sum(1) + (_LEVER_M * xi[:, :3]).square().sum(1)
    return (squared + 1e-8).sqrt()  # smooth at 0, on a scale of a tenth of a millimetre


class Objective(nn.Module):
    """A network with its loss as one module, so that ``DistributedDataParallel`` covers both."""

    def __init__(self, network: OdometryNetwork, settings: LossSettings) -> None:
        super().__init__()
        self.network, self.settings = network, settings

    def forward(self, batch: PairBatch) -> LossValue:
        """Return the loss of a batch."""
        return objective(self.network(batch.network), batch, self.settings, self.network.settings.geometry)
