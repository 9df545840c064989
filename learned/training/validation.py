"""Validation of a network on pairs with a reference: the error of a step, and the drift of chained steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.learned.data.augmentation import perturbed
from hybridlio.learned.data.pairs import Pairs
from hybridlio.learned.data.shards import Shard
from hybridlio.learned.networks.odometry_network import OdometryNetwork
from hybridlio.learned.settings import Recipe
from hybridlio.learned.training.driving import drift_of
from hybridlio.learned.training.objective import objective
from hybridlio.learned.training.processes import ALONE, Processes
from hybridlio.learned.training.validation_result import Validation


@dataclass(frozen=True, eq=False)
class Steps:
    """A network's estimates of all pairs, in their order.

    Attributes:
        poses, initial, reference: ``(N, 4, 4)``; the reference is NaN if unknown.
        loss, po2pl_m: ``(N,)``.
    """

    poses: Array
    initial: Array
    reference: Array
    loss: Array
    po2pl_m: Array


@torch.no_grad()
def run_steps(
    network: OdometryNetwork,
    pairs: Pairs,
    recipe: Recipe,
    place: Processes | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Steps:
    """Estimate every pair, with initial poses perturbed as in training (seed 0, so that validations compare).

    Several processes share the batches; each gets all estimates.
    """
    place = place or ALONE
    was_training, size = network.training, recipe.optimiser.batch
    network.eval()
    parts: list[tuple[Array, ...]] = []
    starts = range(0, len(pairs), size)
    for start in starts[place.rank :: place.count]:
        batch = pairs.batch(range(start, min(start + size, len(pairs))))
        batch = perturbed(batch, recipe.optimiser, seed=0).to(place.device)
        out = network(batch.network)
        value = objective(out, batch, recipe.loss, recipe.network.geometry)
        tensors = (out.pose, out.initial, batch.reference, value.total, value.po2pl_m)
        parts.append(tuple(tensor.double().cpu().numpy() for tensor in tensors))
        if progress is not None:
            progress(min(start + size, len(pairs)), len(pairs))
    network.train(was_training)
    shares = place.gathered(parts)
    in_order = [shares[number % place.count][number // place.count] for number in range(len(starts))]
    return Steps(*(np.concatenate(column) for column in zip(*in_order, strict=True)))


def validate(network: OdometryNetwork, pairs: Pairs, recipe: Recipe, place: Processes | None = None) -> Validation:
    """Run the network on pairs; return loss, and errors for pairs with a reference."""
    steps = run_steps(network, pairs, recipe, place)
    known = np.isfinite(steps.reference).all(axis=(1, 2))
    loss, po2pl = float(steps.loss.mean()), float(steps.po2pl_m.mean())
    if not known.any():
        return Validation(loss, po2pl)
    left = step_errors(steps.poses[known], steps.reference[known])
    before = step_errors(steps.initial[known], steps.reference[known])
    return Validation(loss, po2pl, *left, *before, *_drift(pairs, steps))


def step_errors(poses: Array, reference: Array) -> tuple[float, float]:
    """Return the root mean square error of poses ``(N, 4, 4)`` in degrees and in metres."""
    error = se3.between(reference, poses)
    angles = np.linalg.norm(se3.so3_log(error[:, :3, :3]), axis=1)
    distances = np.linalg.norm(error[:, :3, 3], axis=1)
    return float(np.degrees(np.sqrt((angles**2).mean()))), float(np.sqrt((distances**2).mean()))


def with_errors(reference: Array, rotation_deg: float, translation_m: float) -> Array:
    """Return poses ``(N, 4, 4)`` with random errors of these root mean square sizes, always the same draws."""
    sigmas = np.r_[np.full(3, np.radians(rotation_deg)), np.full(3, translation_m)] / np.sqrt(3)
    draws = np.random.default_rng(0).normal(size=(len(reference), 6)) * sigmas
    return np.asarray(reference @ se3.exp(draws))


@torch.no_grad()
def errors_by_step(
    network: OdometryNetwork, shard: Shard, reference: Array, initial: Array
) -> list[tuple[float, float]]:
    """Return the errors before, and after each of the network's steps, over all pairs of a recording.

    Args:
        network: asked for the residual of each initial pose.
        shard: the recording.
        reference, initial: ``(N, 4, 4)`` relative poses of all its steps.

    Returns:
        root mean squares in degrees and in metres, as :func:`step_errors`.
    """
    # the last velocity is not used here, so pairs without one count too
    pairs, poses = Pairs([shard], replace(network.settings, velocity=False)), []
    rows = [pairs.where(i)[1] - 1 for i in range(len(pairs))]
    for i, row in enumerate(rows):
        given = pairs.batch([i]).network
        start = torch.tensor(initial[row], dtype=torch.float32)[None]
        poses.append(torch.stack(network.refine(given, start).poses)[:, 0].double().numpy())
    found = np.swapaxes(np.array(poses), 0, 1)
    return [step_errors(steps, reference[rows]) for steps in (initial[rows], *found)]


def _drift(pairs: Pairs, steps: Steps) -> tuple[float | None, float | None]:
    """Return the mean drift over recordings without gaps that are long enough, or None."""
    places = [pairs.where(i) for i in range(len(pairs))]
    found = []
    for shard in pairs.shards:
        rows = [i for i, (its_shard, _) in enumerate(places) if its_shard is shard]
        gaps = np.diff([places[i][1] for i in rows]) != 1
        if gaps.any():
            continue
        drift = drift_of(steps.poses[rows], steps.reference[rows])
        if drift is not None:
            found.append(drift)
    if not found:
        return None, None
    means = np.array(found, np.float64).mean(axis=0)
    return float(means[0]), float(means[1])
