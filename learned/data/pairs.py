"""Pairs of consecutive scans as batches of tensors, read from shards."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hybridlio.core.errors import DataError
from hybridlio.learned.data.shards import Shard
from hybridlio.learned.losses.correspondences import Clouds
from hybridlio.learned.networks import torch_se3 as se3
from hybridlio.learned.networks.odometry_network import NetworkInput
from hybridlio.learned.settings import NetworkSettings, OptimiserSettings


@dataclass(frozen=True, eq=False)
class PairBatch:
    """A batch of pairs.

    Attributes:
        network: what the network sees.
        last, current: clouds for the loss, each in its own frame.
        reference: ``(B, 4, 4)`` float32 true relative poses; NaN where not known.
        index: ``(B,)`` number of each pair in its data set.
    """

    network: NetworkInput
    last: Clouds
    current: Clouds
    reference: Tensor
    index: Tensor

    def __len__(self) -> int:
        return len(self.index)

    def to(self, device: torch.device | str) -> PairBatch:
        """The batch on another device."""
        moved: PairBatch = _moved(self, device)
        return moved


def _moved(value: Any, device: torch.device | str) -> Any:
    if isinstance(value, Tensor):
        return value.to(device, non_blocking=True)
    if isinstance(value, PairBatch | NetworkInput | Clouds):
        return replace(value, **{f.name: _moved(getattr(value, f.name), device) for f in fields(value)})
    return value


class Pairs:
    """Every pair of consecutive usable scans of some shards.

    Args:
        shards: opened shards, of the network's cells and number of inertial rows.
        settings: of the network that is to see them; decides which pairs have what it needs.

    Raises:
        DataError: a shard does not go with the settings, or there is no pair left; says which and why.
    """

    def __init__(self, shards: Sequence[Shard], settings: NetworkSettings) -> None:
        self.shards = tuple(shards)
        self._rows: list[tuple[int, int]] = []
        for number, shard in enumerate(self.shards):
            _check_fits(shard, settings)
            good = shard.usable[1:] & shard.usable[:-1]
            if settings.imu in ("initial-pose", "feature"):
                good = good & shard.imu_there[1:]
            if settings.velocity:
                good = good & np.isfinite(shard.velocity_m_s[1:]).all(axis=1)
            if settings.imu == "given":
                good = good & np.isfinite(shard.initial[1:]).all(axis=(1, 2))
            self._rows += [(number, int(k) + 1) for k in np.flatnonzero(good)]
        if not self._rows:
            names = ", ".join(shard.info.name for shard in self.shards) or "no shard"
            raise DataError(f"{names}: no pair of usable scans with what the network needs (imu={settings.imu!r})")

    def __len__(self) -> int:
        return len(self._rows)

    def where(self, index: int) -> tuple[Shard, int]:
        """The shard of a pair and the number of its current scan there."""
        number, k = self._rows[index]
        return self.shards[number], k

    def batch(self, indices: Sequence[int]) -> PairBatch:
        """These pairs together, clouds padded to the largest."""
        places = [self.where(index) for index in indices]
        steps = NetworkInput(
            last=_stack([shard.vertex_map(k - 1) for shard, k in places]),
            current=_stack([shard.vertex_map(k) for shard, k in places]),
            imu=_stack([shard.imu[k] for shard, k in places]),
            dt_s=torch.tensor([float(shard.dt_s[k]) for shard, k in places]),
            velocity_m_s=_stack([np.nan_to_num(shard.velocity_m_s[k]) for shard, k in places]),
            initial=_stack([_or_identity(shard.initial[k]) for shard, k in places]),
        )
        return PairBatch(
            steps,
            padded([shard.loss_cloud(k - 1) for shard, k in places]),
            padded([shard.loss_cloud(k) for shard, k in places]),
            _stack([shard.reference[k] for shard, k in places]),
            torch.tensor(list(indices)),
        )


def padded(clouds: Sequence[tuple[NDArray[np.float32], NDArray[np.float32]]]) -> Clouds:
    """Points and normals ``(K, 3)`` of several scans as one batch, padded to the largest."""
    size = max((len(points) for points, _ in clouds), default=0)
    points, normals = np.zeros((2, len(clouds), size, 3), np.float32)
    there = np.zeros((len(clouds), size), bool)
    for row, (its_points, its_normals) in enumerate(clouds):
        points[row, : len(its_points)] = its_points
        normals[row, : len(its_points)] = its_normals
        there[row, : len(its_points)] = True
    return Clouds(torch.from_numpy(points), torch.from_numpy(normals), torch.from_numpy(there))


def shaken(batch: PairBatch, settings: OptimiserSettings, seed: int) -> PairBatch:
    """The batch with initial poses to be perturbed on the right, and velocities perturbed, each by a draw of its own.

    A pair's draw depends on the seed and on the pair alone, so it is the same in every process and after resuming.
    """
    pose = np.r_[np.full(3, settings.initial_noise_rad), np.full(3, settings.initial_noise_m)]
    sigmas = np.r_[pose, np.full(3, settings.velocity_noise_m_s)]
    if not sigmas.any():
        return batch
    draws = np.array([np.random.default_rng([seed, int(index)]).normal(size=9) * sigmas for index in batch.index])
    noise = torch.tensor(draws, dtype=torch.float32, device=batch.reference.device)
    velocity = batch.network.velocity_m_s + noise[:, 6:]
    return replace(batch, network=replace(batch.network, shake=se3.exp(noise[:, :6]), velocity_m_s=velocity))


def _stack(arrays: Sequence[NDArray[Any]]) -> Tensor:
    return torch.from_numpy(np.stack(arrays).astype(np.float32))


def _or_identity(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    return pose if np.isfinite(pose).all() else np.eye(4)


def _check_fits(shard: Shard, settings: NetworkSettings) -> None:
    if shard.info.geometry != settings.geometry:
        raise DataError(f"{shard.folder}: maps of {shard.info.geometry}, the network takes {settings.geometry}")
    if shard.info.imu_samples != settings.imu_samples:
        raise DataError(
            f"{shard.folder}: {shard.info.imu_samples} inertial rows a pair, the network takes {settings.imu_samples}"
        )
