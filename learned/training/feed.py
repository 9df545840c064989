"""The batches of a training run in order, prefetched by one step."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from hybridlio.learned.data.augmentation import training_batch
from hybridlio.learned.data.pairs import PairBatch, Pairs
from hybridlio.learned.settings import OptimiserSettings
from hybridlio.learned.training.schedule import epoch_order

_EPOCHS_APART = 1_000_003  # a prime above any number of epochs, so that seeds of different runs do not coincide


@dataclass(frozen=True, eq=False)
class Feed:
    """Selects the pairs of each step of a run, and this process's share of them.

    Attributes:
        pairs: training pairs.
        settings: batch size, seed, and how pairs are varied.
        rank, processes: this process's number and the number of all.
    """

    pairs: Pairs
    settings: OptimiserSettings
    rank: int = 0
    processes: int = 1

    def batches(self, first: int, last: int) -> Iterator[tuple[list[int], PairBatch]]:
        """Yield the pairs of steps ``first`` to before ``last`` and this process's share of them as a batch."""
        with ThreadPoolExecutor(1) as reader:
            plan = self._plan(first, last)
            ahead = next(plan, None)
            reading = reader.submit(self._read, *ahead) if ahead else None
            while ahead is not None and reading is not None:
                indices, batch = ahead[1], reading.result()
                ahead = next(plan, None)
                reading = reader.submit(self._read, *ahead) if ahead else None
                yield indices, batch

    def _plan(self, first: int, last: int) -> Iterator[tuple[int, list[int]]]:
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

    def _read(self, epoch: int, indices: list[int]) -> PairBatch:
        # a share is never empty: if a short last batch has too few pairs, its first pair is repeated
        mine = indices[self.rank :: self.processes] or indices[:1]
        return training_batch(self.pairs, mine, self.settings, seed=self.settings.seed * _EPOCHS_APART + epoch)
