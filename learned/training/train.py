"""Training: one flat loop for a CPU, a GPU, or many machines under ``torchrun``.

The result does not depend on the number of processes beyond rounding, with one exception: batch normalisation on CPUs
(see :meth:`hybridlio.learned.training.processes.Processes.joined`).

Source: UnDeepLIO, "Implementation Details". The folder of a run has ``recipe.json``, ``log.jsonl``, ``checkpoint.pt``,
``best.safetensors`` if there is validation data, and after the last step ``weights.safetensors``. A run started again
in the same folder resumes exactly at its last checkpoint.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path

import torch
from torch import Tensor, nn

from hybridlio.core.errors import ConfigError, EstimationError
from hybridlio.core.files import write_atomically
from hybridlio.learned.data.pairs import PairBatch, Pairs
from hybridlio.learned.losses.loss import LossValue
from hybridlio.learned.networks.odometry_network import OdometryNetwork
from hybridlio.learned.networks.weights import put_weights, save_weights
from hybridlio.learned.setting_values import to_dict
from hybridlio.learned.settings import Recipe
from hybridlio.learned.training import checkpoints
from hybridlio.learned.training.best_weights import BestWeights
from hybridlio.learned.training.checkpoints import Checkpoint
from hybridlio.learned.training.feed import Feed
from hybridlio.learned.training.objective import Objective
from hybridlio.learned.training.processes import Processes, processes
from hybridlio.learned.training.schedule import learning_rate
from hybridlio.learned.training.training_log import TrainingLog
from hybridlio.learned.training.validation import validate
from hybridlio.learned.training.validation_result import Validation

CHECKPOINT = "checkpoint.pt"
WEIGHTS = "weights.safetensors"
BEST = "best.safetensors"


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
        about: text for the metadata of the weights.
    """

    device: str | None = None
    checkpoint_every: int = 200
    validate_every: int = 1
    max_steps: int | None = None
    max_seconds: float | None = None
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


def train(
    recipe: Recipe,
    pairs: Pairs,
    out: str | os.PathLike[str],
    validation: Pairs | None = None,
    start: Mapping[str, Tensor] | None = None,
    options: RunOptions | None = None,
    watchers: Watchers | None = None,
) -> OdometryNetwork:
    """Train a network, or go on training it, and return it.

    Args:
        recipe: settings.
        pairs: training data.
        out: folder of the run.
        validation: pairs on which error and drift are measured during training. The best weights are kept beside the
            last ones.
        start: weights to start from, such as shipped ones, named as by
            :func:`hybridlio.learned.networks.weights.own_tensors`; ignored when resuming.
        options: device, checkpoints, limits.
        watchers: functions to call during training.

    Raises:
        ConfigError: the folder holds a run of another recipe or on other data, or the initial weights do not fit; lists
            what differs.
        EstimationError: the loss or its gradient is not finite; the last good checkpoint is kept.
        DataError: the folder's checkpoint cannot be read.
    """
    options = options or RunOptions()
    with processes(options.device) as place:
        run = _Run(recipe, pairs, Path(out), place, options, watchers or Watchers())
        try:
            run.begin(start)
            run.train(validation)
        finally:
            run.log.close() if run.log else None
        return run.network


class _Run:
    """A run's state, between its steps."""

    def __init__(
        self, recipe: Recipe, pairs: Pairs, out: Path, place: Processes, options: RunOptions, watchers: Watchers
    ) -> None:
        self.recipe, self.pairs, self.out, self.place, self.options = recipe, pairs, out, place, options
        self.watchers = watchers
        settings = recipe.optimiser
        torch.manual_seed(settings.seed)
        self.network = OdometryNetwork(recipe.network).to(place.device)
        self.network.mixed_precision = settings.mixed_precision and place.device.type == "cuda"
        self.optimiser = torch.optim.Adam(
            self.network.parameters(), settings.learning_rate, settings.betas, weight_decay=settings.weight_decay
        )
        self.feed = Feed(pairs, settings, place.rank, place.count)
        self.steps_an_epoch = math.ceil(len(pairs) / settings.batch)
        whole = self.steps_an_epoch * settings.epochs
        self.steps = min(whole, options.max_steps or whole)
        self.step, self._between_steps = 0, True
        self.best = BestWeights(out / BEST)
        self.log: TrainingLog | None = None
        self.objective: nn.Module = self.network

    def begin(self, start: Mapping[str, Tensor] | None) -> None:
        """Go on from the folder's checkpoint, or start from the given weights, and write the recipe."""
        found = _checkpoint_in(self.out, self.recipe, len(self.pairs))
        if found is not None:
            checkpoints.restore(found, self.network, self.optimiser)
            self.step = found.step
        elif start is not None:
            put_weights(self.network, start, "initial weights")
        self.place.wait()  # before the first process writes where the others look
        if self.place.leads:
            write_atomically(self.out / "recipe.json", json.dumps(to_dict(self.recipe), indent=2) + "\n")
            self.log = TrainingLog(self.out, self.step)
            self.best.forget_after(self.step)
        self.objective = self.place.joined(Objective(self.network, self.recipe.loss))

    def train(self, validation: Pairs | None) -> None:
        """Take the remaining steps."""
        began, first = time.monotonic(), self.step
        self.network.train()
        try:
            for indices, batch in self.feed.batches(self.step, self.steps):
                loss, po2pl = self._step(indices, batch)
                seconds = time.monotonic() - began
                self._after_step(loss, po2pl, (self.step - first) / seconds)
                if self.step % self.steps_an_epoch == 0:
                    self._after_epoch(validation)
                if self.options.max_seconds is not None and self._agreed(seconds > self.options.max_seconds):
                    break
        except KeyboardInterrupt:
            if self._between_steps:  # otherwise weights are half updated: keep the last checkpoint
                self._save()
            raise
        self._save()
        if self.step >= self.steps and self.place.leads:
            save_weights(self.out / WEIGHTS, self.network, self.recipe, self._origin())

    def _step(self, indices: list[int], batch: PairBatch) -> tuple[float, float]:
        """Take one step; return the mean loss and the mean distance over the pairs of all processes."""
        settings = self.recipe.optimiser
        for group in self.optimiser.param_groups:
            group["lr"] = learning_rate(settings, self.step / self.steps_an_epoch)
        batch = batch.to(self.place.device)
        value: LossValue = self.objective(batch)
        counted = self.place.rank < len(indices)  # otherwise this share repeats a pair, see Feed
        share = value.total.sum() / len(indices) * float(counted)
        self.optimiser.zero_grad(set_to_none=True)
        torch.autograd.backward(share * self.place.count)  # gradients are averaged over processes
        norm = torch.nn.utils.clip_grad_norm_(self.network.parameters(), settings.clip_norm or math.inf)
        sums = torch.stack([share.detach(), value.po2pl_m.sum() / len(indices) * float(counted)])
        loss, po2pl = self.place.total(sums).tolist()
        if not (math.isfinite(loss) and bool(torch.isfinite(norm))):
            raise EstimationError(self._diverged(loss, float(norm), indices))
        self._between_steps = False
        self.optimiser.step()
        self.step += 1
        self._between_steps = True
        return loss, po2pl

    def _diverged(self, loss: float, norm: float, indices: list[int]) -> str:
        kept = self.out / CHECKPOINT
        pairs = [f"{shard.info.name} {k}" for shard, k in map(self.pairs.where, indices[:3])]
        return (
            f"training diverged at step {self.step + 1} (loss {loss}, gradient {norm}; pairs {', '.join(pairs)} …); "
            + (f"the last good checkpoint is {kept}; " if kept.is_file() else "there is no checkpoint yet; ")
            + "lower optimiser.learning_rate or set optimiser.clip_norm"
        )

    def _after_step(self, loss: float, po2pl: float, steps_per_s: float) -> None:
        rate = float(self.optimiser.param_groups[0]["lr"])
        if self.log is not None:
            self.log.write(self.step, loss=loss, po2pl_m=po2pl, learning_rate=rate)
        if self.watchers.progress is not None and self.place.leads:
            epoch = (self.step - 1) // self.steps_an_epoch
            left = (self.steps - self.step) / steps_per_s
            pairs_per_s = steps_per_s * self.recipe.optimiser.batch
            self.watchers.progress(TrainingProgress(self.step, self.steps, epoch, loss, po2pl, rate, pairs_per_s, left))
        if self.step % self.options.checkpoint_every == 0:
            self._save()

    def _after_epoch(self, validation: Pairs | None) -> None:
        due = self.step // self.steps_an_epoch % self.options.validate_every == 0
        if validation is not None and due and self.log is not None:
            found = validate(self.network, validation, self.recipe, self.place.device)
            self.log.write(self.step, **{f"validation/{name}": value for name, value in asdict(found).items()})
            self.best.offer(found, self.step, self.network, self.recipe, self._origin())
            if self.watchers.validated is not None:
                self.watchers.validated(self.step, found)
        self._save()

    def _origin(self) -> dict[str, str]:
        data = ", ".join(f"{shard.info.name} ({len(shard)} scans)" for shard in self.pairs.shards)
        return {"data": data, "pairs": str(len(self.pairs)), "steps": str(self.step), **self.options.about}

    def _agreed(self, mine: bool) -> bool:
        """Return whether any process asks to stop, so that all stop at the same step."""
        return bool(self.place.total(torch.tensor(float(mine), device=self.place.device)) > 0)

    def _save(self) -> None:
        if self.place.leads:
            checkpoints.save(self.out / CHECKPOINT, self._checkpoint())

    def _checkpoint(self) -> Checkpoint:
        return checkpoints.take(self.recipe, len(self.pairs), self.step, self.network, self.optimiser)


def _checkpoint_in(out: Path, recipe: Recipe, pairs: int) -> Checkpoint | None:
    path = out / CHECKPOINT
    if not path.is_file():
        return None
    found = checkpoints.load(path)
    differing = checkpoints.differences(recipe, found.recipe)
    if found.data != pairs:
        differing.append(f"pairs: {found.data} → {pairs}")
    if differing:
        raise ConfigError(
            f"{path}: checkpoint of another run ({'; '.join(differing)}); choose another folder or delete it"
        )
    return found
