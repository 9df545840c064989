"""Devices by name, and the set-up for inference."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hybridlio.core.errors import ConfigError


def pick_device(name: str = "auto") -> torch.device:
    """Return a device by its PyTorch name; ``auto`` is a GPU if available, else the CPU.

    Raises:
        ConfigError: this machine has no such device.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError, ValueError) as error:
        raise ConfigError(f"device {name!r}: {str(error).splitlines()[0]}; choose auto, cpu or cuda") from error
    return device


def on_device(values: NDArray[np.float32] | NDArray[np.float64], device: torch.device) -> Tensor:
    """Return values as a float32 batch of one on a device."""
    return torch.from_numpy(np.asarray(values, np.float32))[None].to(device)


@contextmanager
def at_run_time() -> Iterator[None]:
    """Disable gradients and use one thread: a second one does not speed up single scans and may wait for a core."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.no_grad():
            yield
    finally:
        torch.set_num_threads(threads)
