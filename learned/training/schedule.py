"""The schedule of a training run: the learning rate, and the pairs of each step."""

from __future__ import annotations

import math

import numpy as np

from hybridlio.learned.settings import OptimiserSettings


def learning_rate(settings: OptimiserSettings, epoch: float) -> float:
    """Return the learning rate at a time in epochs."""
    if settings.schedule == "cosine":
        return settings.learning_rate * 0.5 * (1 + math.cos(math.pi * min(epoch / settings.epochs, 1.0)))
    return settings.learning_rate * settings.step_factor ** int(epoch / settings.step_epochs)


def epoch_order(settings: OptimiserSettings, epoch: int, pairs: int) -> list[list[int]]:
    """Return the pairs of each step of an epoch, in an order that depends only on the seed and the epoch."""
    order = np.random.default_rng([settings.seed, epoch]).permutation(pairs).tolist()
    return [order[start : start + settings.batch] for start in range(0, pairs, settings.batch)]
