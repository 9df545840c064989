"""Figures of a validation."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Validation:
    """Figures over a set of pairs; without a reference only the first two.

    Attributes:
        loss: mean over the pairs.
        po2pl_m: mean distance to the matched planes, in metres.
        rotation_rms_deg, translation_rms_m: root mean square of the error of a step.
        initial_rotation_rms_deg, initial_translation_rms_m: the same of the LSTMs' or given initial pose.
        t_rel_percent, r_rel_deg_per_100m: KITTI drift of the chained steps, averaged over recordings.
    """

    loss: float
    po2pl_m: float
    rotation_rms_deg: float | None = None
    translation_rms_m: float | None = None
    initial_rotation_rms_deg: float | None = None
    initial_translation_rms_m: float | None = None
    t_rel_percent: float | None = None
    r_rel_deg_per_100m: float | None = None

    @property
    def score(self) -> float:
        """What selects weights, lower is better: t_rel [%] + r_rel [°/100 m], or the loss where drift is unknown."""
        if self.t_rel_percent is None or self.r_rel_deg_per_100m is None:
            return self.loss
        return self.t_rel_percent + self.r_rel_deg_per_100m
