"""When a training run does what: the learning rate, and which pairs are in which step."""

from __future__ import annotations

import math

import numpy as np

from hybridlio.learned.settings import OptimiserSettings


def learning_rate(settings: OptimiserSettings, epoch: float) -> float:
    """The rate at a time, in epochs."""
    if settings.schedule == "cosine":
        return settings.learning_rate * 0.5 * (1 + math.cos(math.pi * min(epoch / settings.epochs, 1.0)))
    return settings.learning_rate * settings.step_factor ** int(epoch / settings.step_epochs)


def epoch_order(settings: OptimiserSettings, epoch: int, pairs: int) -> list[list[int]]:
    """The pairs of each step of an epoch: a shuffle that depends on the seed and the epoch alone."""
    order = np.random.default_rng([settings.seed, epoch]).permutation(pairs).tolist()
    return [order[start : start + settings.batch] for start in range(0, pairs, settings.batch)]
