"""Single-process training, or distributed training under ``torchrun``."""

from __future__ import annotations

import contextlib
import logging
import os
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TypeVar, cast

import torch
import torch.distributed
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

_log = logging.getLogger(__name__)
_T = TypeVar("_T")
_MAX_READERS = 8  # 4 to 5 ms a pair each: 1,600 pairs a second, more than a current GPU trains


@dataclass(frozen=True)
class Processes:
    """This process's place in distributed training.

    Attributes:
        rank: its index, from 0.
        count: number of processes.
        device: its device.
    """

    rank: int
    count: int
    device: torch.device

    @property
    def leads(self) -> bool:
        """Whether this process writes files and shows progress."""
        return self.rank == 0

    def total(self, value: Tensor) -> Tensor:
        """Return the sum of a value over all processes."""
        if self.count > 1:
            value = value.detach().clone()
            torch.distributed.all_reduce(value)
        return value.detach()

    def any(self, mine: bool) -> bool:
        """Return whether the value is true in any process."""
        return mine if self.count == 1 else bool(self.total(torch.tensor(float(mine), device=self.device)) > 0)

    def gathered(self, mine: _T) -> list[_T]:
        """Return the values of all processes, by their rank. They are pickled; the processes trust each other."""
        if self.count == 1:
            return [mine]
        values: list[_T | None] = [None] * self.count
        torch.distributed.all_gather_object(values, mine)
        return cast("list[_T]", values)

    @property
    def reads_late(self) -> int:
        """Steps by which figures are read late: on a GPU one, which is then still computing the next."""
        return int(self.device.type == "cuda")

    def readers(self, asked: int | None) -> int:
        """Return the number of processes that read batches for this one.

        A CPU trains 50 pairs a second at most, and a thread reads 200. A GPU would wait for it.
        """
        if asked is not None:
            return asked
        return min((os.cpu_count() or 1) // self.count, _MAX_READERS) if self.device.type == "cuda" else 0

    def wait(self) -> None:
        """Block until all processes have called this."""
        if self.count > 1:
            torch.distributed.barrier()

    def joined(self, network: nn.Module, unused: bool) -> nn.Module:
        """Wrap a network, or a network with its loss, so that gradients are averaged over the processes.

        ``unused`` says whether some parameters get no gradient; to find them takes another pass over the graph.

        On GPUs batch normalisation takes its statistics over all processes. PyTorch has no such layer for CPUs: there
        each process normalises by its own share of the batch, and the result depends on the number of processes.
        """
        if self.count == 1:
            return network
        if self.device.type == "cuda":
            network = nn.SyncBatchNorm.convert_sync_batchnorm(network)  # type: ignore[no-untyped-call]
        elif self.leads and any(isinstance(module, nn.BatchNorm2d) for module in network.modules()):
            _log.warning(
                "%d CPU processes: batch normalisation uses each process's own share of the batch, so the result "
                "depends on the number of processes; train with network.normalisation 'group' to avoid this",
                self.count,
            )
        return DistributedDataParallel(network, find_unused_parameters=unused)


ALONE = Processes(0, 1, torch.device("cpu"))
"""A single process on the CPU."""


@contextlib.contextmanager
def processes(device: str | None = None) -> Iterator[Processes]:
    """Join the processes that ``torchrun`` started; without it, yield a single process.

    Args:
        device: name of the device; None selects this process's GPU if available, else the CPU.
    """
    count, rank = int(os.environ.get("WORLD_SIZE", "1")), int(os.environ.get("RANK", "0"))
    local = int(os.environ.get("LOCAL_RANK", "0"))
    if device is None:
        device = f"cuda:{local}" if torch.cuda.is_available() else "cpu"
    place = Processes(rank, count, torch.device(device))
    if place.device.type == "cuda":
        torch.cuda.set_device(place.device)
    started = count > 1 and not torch.distributed.is_initialized()
    if started:
        torch.distributed.init_process_group("nccl" if place.device.type == "cuda" else "gloo")
    try:
        yield place
    finally:
        if started:
            torch.distributed.destroy_process_group()
