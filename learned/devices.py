"""Where to compute, by name."""

from __future__ import annotations

import torch

from hybridlio.errors import ConfigError


def pick_device(name: str = "auto") -> torch.device:
    """The device of a name as PyTorch has it; ``auto`` is a GPU where there is one, else the CPU.

    Raises:
        ConfigError: there is no such device here.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError, ValueError) as error:
        raise ConfigError(f"device {name!r}: {str(error).splitlines()[0]}; choose auto, cpu or cuda") from error
    return device
