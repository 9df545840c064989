"""Figures of training steps, read from a GPU one step late, so that it never waits for the reader."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from hybridlio.learned.losses.loss import LossValue

_NAMES = ("loss", "po2pl_m", "pl2pl", "matched")


def sums_over_pairs(value: LossValue, pairs: int, counted: bool) -> Tensor:
    """Return this process's share ``(4,)`` of the means over a step's pairs: loss, distances, normals, matches.

    Args:
        value: the loss of this process's pairs.
        pairs: number of the step's pairs in all processes.
        counted: False for a process whose pairs another one has too.
    """
    terms = torch.stack([value.total.detach(), value.po2pl_m, value.pl2pl, value.matched])
    return terms.sum(dim=1) / pairs * float(counted)


@dataclass(frozen=True, eq=False)
class StepFigures:
    """Figures of a step, some of them still on the device.

    Attributes:
        step: number of the step, from 1.
        pairs: indices of its pairs.
        learning_rate: of the step.
        waited_s: time until its batch was there.
        took_s: time of the step, with the wait.
        means: ``(4,)`` over the pairs of all processes, see :func:`sums_over_pairs`.
        norm: of the gradient, before it is clipped.
    """

    step: int
    pairs: list[int]
    learning_rate: float
    waited_s: float
    took_s: float
    means: Tensor
    norm: Tensor

    def values(self) -> dict[str, float]:
        """Return the figures by name; this waits for the device."""
        *means, norm = torch.cat([self.means, self.norm.detach().reshape(1)]).tolist()
        named = dict(zip(_NAMES, means, strict=True)) | {"gradient_norm": norm}
        return named | {"learning_rate": self.learning_rate, "waited_s": self.waited_s, "step_s": self.took_s}


def is_finite(values: dict[str, float]) -> bool:
    """Return whether neither the loss nor the gradient has diverged."""
    return math.isfinite(values["loss"]) and math.isfinite(values["gradient_norm"])
