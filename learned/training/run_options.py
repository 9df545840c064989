"""Options of a training run that are not part of its recipe, and what it tells those who watch it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from hybridlio.learned.training.validation_result import Validation


@dataclass(frozen=True)
class TrainingProgress:
    """State of a run after a step.

    Attributes:
        step, steps: steps done, and steps in total.
        epoch: index of the epoch, from 0.
        loss: mean loss of the step's pairs.
        po2pl_m: mean distance to the matched planes, in metres.
        learning_rate: learning rate of the step.
        pairs_per_s: average since the run was started or resumed.
        remaining_s: time for the remaining steps at that rate.
    """

    step: int
    steps: int
    epoch: int
    loss: float
    po2pl_m: float
    learning_rate: float
    pairs_per_s: float
    remaining_s: float


@dataclass(frozen=True)
class RunOptions:
    """Options of a run that do not change its steps.

    Attributes:
        device: name of the device; None selects a GPU if available, else the CPU.
        checkpoint_every: steps between checkpoints; the end of each epoch has one, too.
        validate_every: epochs between validations.
        max_steps: end the run after this many steps in total.
        max_seconds: stop with a checkpoint after this time.
        workers: processes that read batches; 0 reads them in a thread, None selects by the device.
        about: text for the metadata of the weights.
    """

    device: str | None = None
    checkpoint_every: int = 200
    validate_every: int = 1
    max_steps: int | None = None
    max_seconds: float | None = None
    workers: int | None = None
    about: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Watchers:
    """Functions that a run calls in the first process.

    Attributes:
        progress: called after every step.
        validated: called after every validation, with the steps done and the figures.
    """

    progress: Callable[[TrainingProgress], None] | None = None
    validated: Callable[[int, Validation], None] | None = None
