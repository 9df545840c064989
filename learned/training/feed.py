"""The batches of a training run in order, read ahead by a thread or by the workers of a ``DataLoader``.

Both give the same batches: each depends on its step and the seed alone.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import torch
from torch.utils.data import DataLoader, Dataset

from hybridlio.learned.data.augmentation import training_batch
from hybridlio.learned.data.pairs import PairBatch, Pairs
from hybridlio.learned.settings import OptimiserSettings
from hybridlio.learned.training.schedule import epoch_order

_Step = tuple[int, list[int]]  # the epoch of a step, and the indices of its pairs
_EPOCHS_APART = 1_000_003  # a prime above any number of epochs, so that seeds of different runs do not coincide


@dataclass(frozen=True, eq=False)
class Feed:
    """Selects the pairs of each step of a run, and this process's share of them.

    Attributes:
        pairs: training pairs.
        settings: batch size, seed, and how pairs are varied.
        rank, processes: this process's number and the number of all.
        workers: processes that read ahead; 0 reads one step ahead in a thread.
    """

    pairs: Pairs
    settings: OptimiserSettings
    rank: int = 0
    processes: int = 1
    workers: int = 0

    def batches(self, first: int, last: int) -> Iterator[tuple[list[int], PairBatch]]:
        """Yield the pairs of steps ``first`` to before ``last`` and this process's share of them as a batch."""
        yield from (self._by_workers if self.workers else self._by_thread)(self._plan(first, last))

    def _by_thread(self, plan: Iterator[_Step]) -> Iterator[tuple[list[int], PairBatch]]:
        with ThreadPoolExecutor(1) as reader:
            ahead = next(plan, None)
            reading = reader.submit(self.read, ahead) if ahead else None
            while ahead is not None and reading is not None:
                indices, batch = ahead[1], reading.result()
                ahead = next(plan, None)
                reading = reader.submit(self.read, ahead) if ahead else None
                yield indices, batch

    def _by_workers(self, plan: Iterator[_Step]) -> Iterator[tuple[list[int], PairBatch]]:
        steps, keys = itertools.tee(plan)
        pinned = torch.cuda.is_available()  # copies from pinned memory do not wait for the GPU
        loader = DataLoader(
            _Batches(self),
            sampler=keys,
            batch_size=None,
            num_workers=self.workers,
            pin_memory=pinned,
            collate_fn=_as_is,
        )
        for (_, indices), batch in zip(steps, loader, strict=True):
            yield indices, batch

    def _plan(self, first: int, last: int) -> Iterator[_Step]:
        """Yield the epoch and the pairs of each step."""
        steps_an_epoch = -(-len(self.pairs) // self.settings.batch)
        epoch, skip = divmod(first, steps_an_epoch)
        step = first
        while step < last:
            for indices in epoch_order(self.settings, epoch, len(self.pairs))[skip:]:
                if step >= last:
                    return
                yield epoch, indices
                step += 1
            epoch, skip = epoch + 1, 0

    def read(self, step: _Step) -> PairBatch:
        """Return this process's share of a step's pairs as a batch."""
        epoch, indices = step
        # a share is never empty: if a short last batch has too few pairs, its first pair is repeated
        mine = indices[self.rank :: self.processes] or indices[:1]
        return training_batch(self.pairs, mine, self.settings, seed=self.settings.seed * _EPOCHS_APART + epoch)


class _Batches(Dataset[PairBatch]):
    """The batches of a feed by their steps, for the workers of a ``DataLoader``."""

    def __init__(self, feed: Feed) -> None:
        self.feed = feed

    def __getitem__(self, step: _Step) -> PairBatch:
        return self.feed.read(step)


def _as_is(batch: Any) -> Any:
    return batch
