"""Evaluation of a network on a recording in sequence, as at run time, with its own estimate as last velocity."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.core.errors import DataError
from hybridlio.core.trajectory import Trajectory
from hybridlio.evaluation.drift import kitti_drift, lengths_for
from hybridlio.learned.data.pairs import Pairs
from hybridlio.learned.data.shards import Shard
from hybridlio.learned.networks.odometry_network import OdometryNetwork


@dataclass(frozen=True, eq=False)
class DrivenSteps:
    """A network's estimates of a recording's steps, in order.

    Attributes:
        poses, initial, reference: ``T_k_k1`` ``(N, 4, 4)``: estimates, initial poses, and reference (NaN if
            unknown).
    """

    poses: Array
    initial: Array
    reference: Array

    @property
    def drift(self) -> tuple[float, float] | None:
        """KITTI drift of the chained steps, see :func:`drift_of`."""
        return drift_of(self.poses, self.reference)


@torch.no_grad()
def drive(
    network: OdometryNetwork,
    shard: Shard,
    progress: Callable[[int, int], None] | None = None,
) -> DrivenSteps:
    """Estimate a recording's steps in order.

    A network with velocity input takes its previous estimate; the first step takes the shard's velocity, so
    initialisation of the velocity is not evaluated. Steps before the first known velocity are left out; later ones
    need none.

    Raises:
        DataError: the recording has no usable steps, or an unusable scan between them.
    """
    first, pairs = 0, Pairs([shard], replace(network.settings, velocity=False))
    if network.settings.velocity:
        known_from = Pairs([shard], network.settings).where(0)[1]
        first = next(i for i in range(len(pairs)) if pairs.where(i)[1] == known_from)
    gaps = np.diff([pairs.where(i)[1] for i in range(first, len(pairs))]) != 1
    if gaps.any():
        unusable = pairs.where(first + int(gaps.argmax()))[1] + 1
        raise DataError(f"{shard.folder}: scan {unusable} is not usable; choose one without gaps")
    was_training, device = network.training, next(network.parameters()).device
    network.eval()
    found: list[tuple[Array, Array, Array]] = []
    velocity: torch.Tensor | None = None
    for i in range(first, len(pairs)):
        batch = pairs.batch([i]).to(device)
        given = batch.network if velocity is None else replace(batch.network, velocity_m_s=velocity)
        out = network(given)
        if network.settings.velocity:
            R, t = out.pose[:, :3, :3], out.pose[:, :3, 3:]
            velocity = (R.transpose(1, 2) @ t)[..., 0] / given.dt_s[:, None]
        pose, initial, reference = (x.double().cpu().numpy()[0] for x in (out.pose, out.initial, batch.reference))
        found.append((pose, initial, reference))
        if progress is not None:
            progress(i + 1 - first, len(pairs) - first)
    network.train(was_training)
    return DrivenSteps(*(np.stack(column) for column in zip(*found, strict=True)))


def drift_of(poses: Array, reference: Array) -> tuple[float, float] | None:
    """Return KITTI's t_rel (percent) and r_rel (degrees per 100 m) of chained steps ``(N, 4, 4)``.

    Segments start at every scan. Return None if any reference is unknown, or the path is shorter than every
    segment.
    """
    if not len(poses) or not np.isfinite(reference).all():
        return None
    path_m = float(np.linalg.norm(reference[:, :3, 3], axis=1).sum())
    drift = kitti_drift(_chained(poses), _chained(reference), lengths_for(path_m), step=1)
    t_rel, r_rel = drift.t_rel_percent, drift.r_rel_deg_per_100m
    return None if t_rel is None or r_rel is None else (t_rel, r_rel)


def _chained(steps: Array) -> Trajectory:
    poses = [np.eye(4)]
    for step in steps:
        poses.append(se3.orthonormalise(poses[-1] @ step))
    return Trajectory(np.arange(len(poses)) * 100_000_000, np.array(poses))
