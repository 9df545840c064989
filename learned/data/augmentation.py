"""Augmentation of training pairs: mirrored, reversed in time, with perturbed initial poses, with fewer points.

Every draw depends on a seed and on the pair alone, so that it is the same in every process and after resuming. Not in
the paper.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hybridlio.learned.data.pairs import PairBatch, Pairs
from hybridlio.learned.losses.correspondences import Clouds
from hybridlio.learned.networks import torch_se3 as se3
from hybridlio.learned.settings import OptimiserSettings

_VARYING, _DRAWING = 1, 2  # stream numbers of the random generators, next to that of perturbations; any distinct ones


def training_batch(pairs: Pairs, indices: Sequence[int], settings: OptimiserSettings, seed: int) -> PairBatch:
    """Return a batch of these pairs, augmented by the settings."""
    draws = np.array([np.random.default_rng([seed, i, _VARYING]).random(2) for i in indices])
    backwards = [i for i, draw in zip(indices, draws, strict=True) if draw[1] < settings.swapped and pairs.swappable(i)]
    batch = mirrored(pairs.batch(indices, backwards), torch.from_numpy(draws[:, 0] < settings.mirrored))
    return perturbed(with_points(batch, settings, seed), settings, seed)


def perturbed(batch: PairBatch, settings: OptimiserSettings, seed: int) -> PairBatch:
    """Return the batch with a perturbation of each initial pose, on the right, and with perturbed velocities."""
    pose = np.r_[np.full(3, settings.initial_noise_rad), np.full(3, settings.initial_noise_m)]
    sigmas = np.r_[pose, np.full(3, settings.velocity_noise_m_s)]
    if not sigmas.any():
        return batch
    draws = np.array([np.random.default_rng([seed, int(index)]).normal(size=9) * sigmas for index in batch.index])
    noise = torch.tensor(draws, dtype=torch.float32, device=batch.reference.device)
    velocity = batch.network.velocity_m_s + noise[:, 6:]
    return replace(batch, network=replace(batch.network, perturbation=se3.exp(noise[:, :6]), velocity_m_s=velocity))


def mirrored(batch: PairBatch, rows: Tensor) -> PairBatch:
    """Return the batch with the pairs of ``rows`` ``(B,)`` bool mirrored in y (left and right swapped)."""
    if not bool(rows.any()):
        return batch
    given = batch.network
    sign = torch.where(rows, -1.0, 1.0)[:, None]
    one = torch.ones_like(sign)
    polar = torch.cat([one, sign, one], dim=1)  # of points and velocities
    axial = torch.cat([sign, one, sign], dim=1)  # of angular velocities
    flipped = rows[:, None, None, None]
    maps = [
        torch.where(flipped, vertices.flip(-1), vertices) * polar[..., None, None]
        for vertices in (given.last, given.current)
    ]
    network = replace(
        given,
        last=maps[0],
        current=maps[1],
        imu=given.imu * torch.cat([axial, polar], dim=1)[:, None],
        velocity_m_s=given.velocity_m_s * polar,
        initial=None if given.initial is None else _mirrored_poses(given.initial, polar),
    )
    last, current = (
        replace(cloud, points=cloud.points * polar[:, None], normals=cloud.normals * polar[:, None])
        for cloud in (batch.last, batch.current)
    )
    return replace(
        batch, network=network, last=last, current=current, reference=_mirrored_poses(batch.reference, polar)
    )


def _mirrored_poses(poses: Tensor, polar: Tensor) -> Tensor:
    """Return ``M T M`` for the mirror ``M`` with ``polar`` ``(B, 3)`` on its diagonal."""
    mirror = torch.cat([polar, torch.ones_like(polar[:, :1])], dim=1)
    return mirror[:, :, None] * poses * mirror[:, None, :]


def with_points(batch: PairBatch, settings: OptimiserSettings, seed: int) -> PairBatch:
    """Return the batch with ``settings.points`` points of each current cloud, drawn anew for each pair and seed.

    A share ``settings.balanced`` of them comes in equal numbers from the points whose normals lie mainly along x, y and
    z (normal-space sampling: Rusinkiewicz and Levoy, "Efficient variants of the ICP algorithm", 2001). Few surfaces
    face the direction of travel, so without it the loss hardly weighs how far the sensor went.
    """
    cloud = batch.current
    if not settings.points or settings.points >= cloud.points.shape[1]:
        return batch
    axes = torch.where(cloud.normals.any(-1), cloud.normals.abs().argmax(-1), -1).numpy()
    chosen = torch.stack(
        [
            torch.from_numpy(_draw(axis[there], settings, np.random.default_rng([seed, int(index), _DRAWING])))
            for index, axis, there in zip(batch.index, axes, cloud.there.numpy(), strict=True)
        ]
    )
    each = chosen[..., None].expand(-1, -1, 3)
    thinned = Clouds(cloud.points.gather(1, each), cloud.normals.gather(1, each), cloud.there.gather(1, chosen))
    return replace(batch, current=thinned)


def _draw(axes: NDArray[np.int64], settings: OptimiserSettings, rng: np.random.Generator) -> NDArray[np.int64]:
    """Return rows ``(settings.points,)`` of points whose normals lie mainly along ``axes`` (-1 without a normal)."""
    of_axis = int(settings.points * settings.balanced) // 3
    groups = [np.flatnonzero(axes == axis) for axis in range(3)]
    parts = [rng.choice(group, of_axis) for group in groups if len(group)]
    left = settings.points - sum(map(len, parts))
    return np.concatenate([*parts, rng.integers(0, max(len(axes), 1), left)]).astype(np.int64)
