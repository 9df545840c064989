"""Checkpoints: the full state of a training run in one file, written atomically."""

from __future__ import annotations

import io
import os
import pickle
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from hybridlio.core.errors import ConfigError, DataError
from hybridlio.core.files import write_atomically
from hybridlio.learned.setting_values import from_dict, to_dict
from hybridlio.learned.settings import Recipe

# raised by PyTorch and ours where a checkpoint is damaged
_MALFORMED = (
    OSError, RuntimeError, pickle.UnpicklingError, EOFError, KeyError, IndexError, TypeError, ValueError,
    AttributeError, OverflowError, ConfigError,
)  # fmt: skip
FORMAT = 1  # raise by 1 when the fields of a checkpoint change


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """State of a training run.

    Attributes:
        recipe: settings of the run.
        data: pairs in an epoch.
        step: steps done.
        network: state of the network.
        optimiser: state of the optimiser.
        random: states of PyTorch's random generators by device type.
    """

    recipe: Recipe
    data: int
    step: int
    network: dict[str, Tensor]
    optimiser: dict[str, Any]
    random: dict[str, Tensor]


def take(recipe: Recipe, data: int, step: int, network: nn.Module, optimiser: Optimizer) -> Checkpoint:
    """Return the current state of a run."""
    random = {"cpu": torch.get_rng_state()}
    if torch.cuda.is_available():
        random["cuda"] = torch.cuda.get_rng_state()
    return Checkpoint(recipe, data, step, network.state_dict(), optimiser.state_dict(), random)


def restore(checkpoint: Checkpoint, network: nn.Module, optimiser: Optimizer) -> None:
    """Set network, optimiser and random generators to the state of a checkpoint.

    Raises:
        DataError: the state is not that of such a network.
    """
    try:
        network.load_state_dict(checkpoint.network)
        optimiser.load_state_dict(checkpoint.optimiser)
        torch.set_rng_state(checkpoint.random["cpu"])
    except _MALFORMED as error:
        raise DataError(f"the checkpoint does not fit its recipe ({_line(error)}); delete it to start again") from error
    if "cuda" in checkpoint.random and torch.cuda.is_available():
        torch.cuda.set_rng_state(checkpoint.random["cuda"])


def save(path: str | os.PathLike[str], checkpoint: Checkpoint) -> None:
    """Write a checkpoint atomically."""
    buffer = io.BytesIO()
    values = {
        "format": FORMAT,
        "recipe": to_dict(checkpoint.recipe),
        "data": checkpoint.data,
        "step": checkpoint.step,
        "network": checkpoint.network,
        "optimiser": checkpoint.optimiser,
        "random": checkpoint.random,
    }
    torch.save(values, buffer)
    write_atomically(path, buffer.getvalue())


def load(path: str | os.PathLike[str]) -> Checkpoint:
    """Read a checkpoint onto the CPU. Only plain values and tensors are loaded, never code.

    Raises:
        DataError: the file is not a checkpoint, or has the format of another version.
    """
    path = Path(path)
    try:
        with warnings.catch_warnings():  # PyTorch's on a damaged file come before its error
            warnings.simplefilter("ignore")
            values = torch.load(path, map_location="cpu", weights_only=True)
        if values["format"] != FORMAT:
            raise DataError(f"{path}: format {values['format']}; this version reads format {FORMAT}")
        return Checkpoint(
            from_dict(Recipe, values["recipe"], "recipe"),
            values["data"],
            values["step"],
            values["network"],
            values["optimiser"],
            values["random"],
        )
    except _MALFORMED as error:
        raise DataError(
            f"{path}: not a checkpoint that can be resumed ({_line(error)}); delete it to start again"
        ) from error


def _line(error: BaseException) -> str:
    """Return the first line of an error; PyTorch's tell much more."""
    return str(error).partition("\n")[0] or type(error).__name__


def differences(wanted: Recipe, found: Recipe) -> list[str]:
    """Return the settings in which two recipes differ, as ``section.key: found → wanted``; names are ignored."""
    texts = []
    a, b = to_dict(wanted), to_dict(found)
    for section in ("network", "loss", "optimiser"):
        texts += [
            f"{section}.{key}: {b[section][key]} → {value}"
            for key, value in a[section].items()
            if b[section][key] != value
        ]
    return texts
