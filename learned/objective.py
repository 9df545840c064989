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
    """The loss of a batch, averaged over the network's iterations."""
    clouds = clouds_for(batch, settings)
    values = [pose_loss(pose, clouds, settings, geometry) for pose in output.poses]
    total = torch.stack([value.total for value in values]).mean(0)
    return LossValue(total, values[-1].po2pl_m, values[-1].pl2pl, values[-1].matched)
