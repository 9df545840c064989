"""What a batch costs: the loss of what the network says, with matches looked for at its answer."""

from __future__ import annotations

import torch
from torch import Tensor

from hybridlio.learned.correspondences import Clouds, match
from hybridlio.learned.losses import LossValue, loss
from hybridlio.learned.odometry_network import NetworkOutput
from hybridlio.learned.pairs import PairBatch
from hybridlio.learned.settings import LossSettings
from hybridlio.projection import MapGeometry


def clouds_for(batch: PairBatch, settings: LossSettings) -> tuple[Clouds, Clouds]:
    """Last and current clouds that the matching is about: the whole averaged clouds, or what the maps show."""
    if settings.matching == "nearest":
        return batch.last, batch.current
    return Clouds.of_maps(batch.network.last), Clouds.of_maps(batch.network.current)


def pose_loss(pose: Tensor, clouds: tuple[Clouds, Clouds], settings: LossSettings, geometry: MapGeometry) -> LossValue:
    """The loss of poses ``(B, 4, 4)`` with matches looked for at them."""
    return loss(match(pose, *clouds, settings, geometry), pose, settings)


def objective(output: NetworkOutput, batch: PairBatch, settings: LossSettings, geometry: MapGeometry) -> LossValue:
    """The loss of a batch, averaged over the network's steps, with the initial pose's where it is given a weight."""
    clouds = clouds_for(batch, settings)
    poses = [*output.poses, output.initial] if settings.initial_weight else list(output.poses)
    if settings.matched_at == "answer":
        matches = match(output.pose, *clouds, settings, geometry)
        values = [loss(matches, pose, settings) for pose in poses]
    else:
        values = [pose_loss(pose, clouds, settings, geometry) for pose in poses]
    steps, answer = len(output.poses), values[len(output.poses) - 1]
    total = torch.stack([value.total for value in values[:steps]]).mean(0)
    for value in values[steps:]:
        total = total + settings.initial_weight * value.total
    return LossValue(total, answer.po2pl_m, answer.pl2pl, answer.matched)
