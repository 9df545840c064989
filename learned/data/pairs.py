"""Pairs of consecutive scans as batches of tensors, read from shards."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hybridlio.core import se3
from hybridlio.core.errors import DataError
from hybridlio.learned.data.shards import Shard
from hybridlio.learned.losses.correspondences import Clouds
from hybridlio.learned.networks.network_types import NetworkInput
from hybridlio.learned.settings import NetworkSettings


@dataclass(frozen=True, eq=False)
class PairBatch:
    """A batch of pairs.

    Attributes:
        network: inputs of the network.
        last, current: clouds for the loss, each in its own frame.
        reference: ``(B, 4, 4)`` float32 true relative poses; NaN where unknown.
        index: ``(B,)`` index of each pair in its data set.
    """

    network: NetworkInput
    last: Clouds
    current: Clouds
    reference: Tensor
    index: Tensor

    def __len__(self) -> int:
        return len(self.index)

    def to(self, device: torch.device | str) -> PairBatch:
        """Return the batch on another device."""
        moved: PairBatch = _changed(self, lambda tensor: tensor.to(device, non_blocking=True))
        return moved

    def pin_memory(self) -> PairBatch:
        """Return the batch in pinned memory, as a ``DataLoader`` asks for."""
        pinned: PairBatch = _changed(self, Tensor.pin_memory)
        return pinned


def _changed(value: Any, change: Callable[[Tensor], Tensor]) -> Any:
    if isinstance(value, Tensor):
        return change(value)
    if isinstance(value, PairBatch | NetworkInput | Clouds):
        return replace(value, **{f.name: _changed(getattr(value, f.name), change) for f in fields(value)})
    return value


class Pairs:
    """Every pair of consecutive usable scans of some shards.

    Args:
        shards: opened shards, with the network's map geometry and number of IMU rows.
        settings: of the network; pairs without the inputs that it needs are left out.

    Raises:
        DataError: a shard does not fit the settings, or no pair is left; names the shard and the reason.
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
            raise DataError(
                f"{names}: no pair of usable scans with the inputs that the network needs (imu={settings.imu!r}, "
                f"velocity={settings.velocity})"
            )

    def __len__(self) -> int:
        return len(self._rows)

    def where(self, index: int) -> tuple[Shard, int]:
        """Return the shard of a pair and the index of its current scan there."""
        number, k = self._rows[index]
        return self.shards[number], k

    def swappable(self, index: int) -> bool:
        """Return whether :meth:`batch` can reverse a pair in time: the velocity after it is known."""
        shard, k = self.where(index)
        if k + 2 >= len(shard):
            return False
        return bool(shard.imu_there[k + 1]) and bool(np.isfinite(shard.velocity_m_s[k + 2]).all())

    def batch(self, indices: Sequence[int], backwards: Collection[int] = ()) -> PairBatch:
        """Return a batch of pairs, with clouds padded to the largest.

        Args:
            indices: indices of the pairs.
            backwards: the indices of pairs to reverse in time, from the current scan to the last one.
        """
        steps = [(_backward_step if index in backwards else _forward_step)(*self.where(index)) for index in indices]
        given = NetworkInput(
            last=_stack([step.shard.vertex_map(step.last) for step in steps]),
            current=_stack([step.shard.vertex_map(step.current) for step in steps]),
            imu=_stack([step.imu for step in steps]),
            dt_s=torch.tensor([step.dt_s for step in steps]),
            velocity_m_s=_stack([np.nan_to_num(step.velocity_m_s) for step in steps]),
            initial=_stack([_or_identity(step.initial) for step in steps]),
        )
        return PairBatch(
            given,
            padded([step.shard.loss_cloud(step.last) for step in steps]),
            padded([step.shard.loss_cloud(step.current) for step in steps]),
            _stack([step.reference for step in steps]),
            torch.tensor(list(indices)),
        )


@dataclass(frozen=True, eq=False)
class _Step:
    """A pair of a shard, or its reverse in time: scan numbers, and the data of the step between them."""

    shard: Shard
    last: int
    current: int
    imu: NDArray[np.float32]
    dt_s: float
    velocity_m_s: NDArray[np.float32]
    initial: NDArray[np.float64]
    reference: NDArray[np.float64]


def _forward_step(shard: Shard, k: int) -> _Step:
    poses = shard.initial[k], shard.reference[k]
    return _Step(shard, k - 1, k, shard.imu[k], float(shard.dt_s[k]), shard.velocity_m_s[k], *poses)


def _backward_step(shard: Shard, k: int) -> _Step:
    """The step from scan k to k-1. Time runs backwards: angular velocities change sign, specific forces do not."""
    imu = shard.imu[k, ::-1] * np.array([-1, -1, -1, 1, 1, 1], np.float32)
    # row k+2 holds the mean velocity from k to k+1, in the axes of k+1; the mean rate between them leads to those of k
    turned = se3.so3_exp(shard.imu[k + 1, :, :3].mean(axis=0).astype(np.float64) * float(shard.dt_s[k + 1]))
    velocity = -(turned @ shard.velocity_m_s[k + 2])
    poses = se3.inverse(shard.initial[k]), se3.inverse(shard.reference[k])
    return _Step(shard, k, k - 1, imu, float(shard.dt_s[k]), velocity.astype(np.float32), *poses)


def padded(clouds: Sequence[tuple[NDArray[np.float32], NDArray[np.float32]]]) -> Clouds:
    """Return points and normals ``(K, 3)`` of several scans as one batch, padded to the largest."""
    size = max((len(points) for points, _ in clouds), default=0)
    points, normals = np.zeros((2, len(clouds), size, 3), np.float32)
    there = np.zeros((len(clouds), size), bool)
    for row, (its_points, its_normals) in enumerate(clouds):
        points[row, : len(its_points)] = its_points
        normals[row, : len(its_points)] = its_normals
        there[row, : len(its_points)] = True
    return Clouds(torch.from_numpy(points), torch.from_numpy(normals), torch.from_numpy(there))


def _stack(arrays: Sequence[NDArray[Any]]) -> Tensor:
    return torch.from_numpy(np.stack(arrays).astype(np.float32))


def _or_identity(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    return pose if np.isfinite(pose).all() else np.eye(4)


def _check_fits(shard: Shard, settings: NetworkSettings) -> None:
    if shard.info.geometry != settings.geometry:
        raise DataError(f"{shard.folder}: maps of {shard.info.geometry}, the network takes {settings.geometry}")
    if shard.info.imu_samples != settings.imu_samples:
        raise DataError(
            f"{shard.folder}: {shard.info.imu_samples} IMU rows a pair, the network takes {settings.imu_samples}"
        )
