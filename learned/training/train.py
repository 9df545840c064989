"""Training: one flat loop for a CPU, a GPU, or many machines under ``torchrun``.

The result does not depend on the number of processes beyond rounding, with one exception: batch normalisation on CPUs
(see :meth:`hybridlio.learned.training.processes.Processes.joined`).

Source: UnDeepLIO, "Implementation Details". The folder of a run has ``recipe.json``, ``log.jsonl``, ``checkpoint.pt``,
``best.safetensors`` if there is validation data, and after the last step ``weights.safetensors``. A run started again
in the same folder resumes exactly at its last checkpoint.
"""

from __future__ import annotations

import copy
import json
import math
import os
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import asdict
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
from hybridlio.learned.training.run_options import RunOptions, TrainingProgress, Watchers
from hybridlio.learned.training.schedule import learning_rate
from hybridlio.learned.training.step_figures import StepFigures, is_finite, sums_over_pairs
from hybridlio.learned.training.training_log import TrainingLog
from hybridlio.learned.training.validation import validate
from hybridlio.learned.training.validation_result import Validation

CHECKPOINT = "checkpoint.pt"
WEIGHTS = "weights.safetensors"
BEST = "best.safetensors"


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
        self.feed = Feed(pairs, settings, place.rank, place.count, place.readers(options.workers))
        self.steps_an_epoch = math.ceil(len(pairs) / settings.batch)
        whole = self.steps_an_epoch * settings.epochs
        self.steps = min(whole, options.max_steps or whole)
        self.step, self._between_steps = 0, True
        self.best = BestWeights(out / BEST)
        self.log: TrainingLog | None = None
        self.objective: nn.Module = self.network
        self._unread: deque[StepFigures] = deque()
        self._began, self._first = time.monotonic(), 0

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
        objective = Objective(self.network, self.recipe.loss)
        unused = self.place.count > 1 and self._leaves_parameters_unused(objective)
        self.objective = self.place.joined(objective, unused)

    def _leaves_parameters_unused(self, objective: Objective) -> bool:
        """Return whether a pair gives some parameters no gradient, such as LSTMs before steps without it."""
        tried = copy.deepcopy(objective)  # batch normalisation keeps statistics of what it sees
        tried(self.pairs.batch([0]).to(self.place.device)).total.sum().backward()
        return any(parameter.grad is None for parameter in tried.parameters())

    def train(self, validation: Pairs | None) -> None:
        """Take the remaining steps."""
        self._began, self._first = time.monotonic(), self.step
        self.network.train()
        asked = time.monotonic()
        try:
            for indices, batch in self.feed.batches(self.step, self.steps):
                self._step(indices, batch, asked)
                if self.step % self.options.checkpoint_every == 0:
                    self._save()
                if self.step % self.steps_an_epoch == 0:
                    self._after_epoch(validation)
                if self._is_out_of_time():
                    break
                asked = time.monotonic()
        except KeyboardInterrupt:
            if self._between_steps:  # otherwise weights are half updated: keep the last checkpoint
                self._save()
            raise
        self._save()
        if self.step >= self.steps and self.place.leads:
            save_weights(self.out / WEIGHTS, self.network, self.recipe, self._origin())

    def _step(self, indices: list[int], batch: PairBatch, asked: float) -> None:
        """Take one step with a batch that was asked for at a time, and report the figures that are there."""
        settings, waited_s = self.recipe.optimiser, time.monotonic() - asked
        rate = learning_rate(settings, self.step / self.steps_an_epoch)
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        value: LossValue = self.objective(batch.to(self.place.device))
        counted = self.place.rank < len(indices)  # otherwise this share repeats a pair, see Feed
        share = value.total.sum() / len(indices) * float(counted)
        self.optimiser.zero_grad(set_to_none=True)
        torch.autograd.backward(share * self.place.count)  # gradients are averaged over processes
        norm = torch.nn.utils.clip_grad_norm_(self.network.parameters(), settings.clip_norm or math.inf)
        means = self.place.total(sums_over_pairs(value, len(indices), counted))
        took_s = time.monotonic() - asked
        self._unread.append(StepFigures(self.step + 1, indices, rate, waited_s, took_s, means, norm))
        ready = self._checked(keep=self.place.reads_late)
        self._between_steps = False
        self.optimiser.step()
        self.step += 1
        self._between_steps = True
        self._report(ready)

    def _checked(self, keep: int = 0) -> list[tuple[int, dict[str, float]]]:
        """Read the figures of all but the last ``keep`` steps, and return them by their step.

        Raises:
            EstimationError: a loss or gradient is not finite.
        """
        ready = []
        while len(self._unread) > keep:
            figures = self._unread.popleft()
            values = figures.values()
            if not is_finite(values):
                self._unread.clear()
                raise EstimationError(self._diverged(figures, values))
            ready.append((figures.step, values))
        return ready

    def _diverged(self, figures: StepFigures, values: Mapping[str, float]) -> str:
        kept = self.out / CHECKPOINT
        pairs = [f"{shard.info.name} {k}" for shard, k in map(self.pairs.where, figures.pairs[:3])]
        return (
            f"training diverged at step {figures.step} (loss {values['loss']}, gradient {values['gradient_norm']}; "
            f"pairs {', '.join(pairs)} …); "
            + (f"the last good checkpoint is {kept}; " if kept.is_file() else "there is no checkpoint yet; ")
            + "lower optimiser.learning_rate or set optimiser.clip_norm"
        )

    def _report(self, ready: list[tuple[int, dict[str, float]]]) -> None:
        """Log the figures of steps, and show the progress."""
        for step, values in ready:
            if self.log is not None:
                self.log.write(step, **values)
            if self.watchers.progress is not None and self.place.leads:
                self.watchers.progress(self._progress(step, values))

    def _progress(self, step: int, values: Mapping[str, float]) -> TrainingProgress:
        steps_per_s = (step - self._first) / (time.monotonic() - self._began)
        epoch, left = (step - 1) // self.steps_an_epoch, (self.steps - step) / steps_per_s
        pairs_per_s = steps_per_s * self.recipe.optimiser.batch
        loss, po2pl_m, rate = values["loss"], values["po2pl_m"], values["learning_rate"]
        return TrainingProgress(step, self.steps, epoch, loss, po2pl_m, rate, pairs_per_s, left)

    def _after_epoch(self, validation: Pairs | None) -> None:
        due = self.step // self.steps_an_epoch % self.options.validate_every == 0
        self._report(self._checked())
        if validation is not None and due:
            found = validate(self.network, validation, self.recipe, self.place)
            if self.log is not None:
                self._keep_validation(found, self.log)
        self._save()

    def _keep_validation(self, found: Validation, log: TrainingLog) -> None:
        log.write(self.step, **{f"validation/{name}": value for name, value in asdict(found).items()})
        self.best.offer(found, self.step, self.network, self.recipe, self._origin())
        if self.watchers.validated is not None:
            self.watchers.validated(self.step, found)

    def _origin(self) -> dict[str, str]:
        data = ", ".join(f"{shard.info.name} ({len(shard)} scans)" for shard in self.pairs.shards)
        return {"data": data, "pairs": str(len(self.pairs)), "steps": str(self.step), **self.options.about}

    def _is_out_of_time(self) -> bool:
        """Return whether any process has no time left, so that all stop at the same step."""
        limit_s = self.options.max_seconds
        return limit_s is not None and self.place.any(time.monotonic() - self._began > limit_s)

    def _save(self) -> None:
        self._report(self._checked())  # a checkpoint is good: no step before it has diverged
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
