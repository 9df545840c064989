"""Weights in safetensors files; their metadata hold recipe, training data, version and commit."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from hybridlio.cloud.map_geometry import MapGeometry
from hybridlio.core.errors import ConfigError, DataError
from hybridlio.core.files import write_atomically
from hybridlio.core.version import __version__
from hybridlio.learned.networks.odometry_network import OdometryNetwork
from hybridlio.learned.setting_values import from_dict, to_dict
from hybridlio.learned.settings import NetworkSettings, Recipe
from hybridlio.learned.source_settings import SHIPPED

_LISTED = 6  # mismatches in a message: a network of another structure differs in all tensors


def shipped(name: str = "default") -> Path:
    """Return the path of weights that come with the package, ``learned/NAME.safetensors``.

    Raises:
        ConfigError: there are none of that name; lists those that are shipped.
    """
    folder = Path(__file__).resolve().parents[1]
    path = folder / f"{name}.safetensors"
    if not path.is_file():
        known = ", ".join(sorted(file.stem for file in folder.glob("*.safetensors"))) or "none"
        raise ConfigError(f"no weights named {name!r} are shipped; choose one of {known}, or give the path of a file")
    return path


@dataclass(frozen=True, eq=False)
class Weights:
    """A file of weights.

    Attributes:
        recipe: settings of their training; its network settings are the structure that they fit.
        about: training data, steps, version and commit, as text.
        tensors: weights and buffers by name.
        where: path of the file, for messages.
    """

    recipe: Recipe
    about: Mapping[str, str]
    tensors: Mapping[str, Tensor]
    where: str = "weights"

    def fitting(self, network: NetworkSettings) -> Mapping[str, Tensor]:
        """Return the tensors that a network of these settings needs: without those of LSTMs for ``imu="given"``."""
        if self.recipe.network.imu == "initial-pose" and network.imu == "given":
            return {name: tensor for name, tensor in self.tensors.items() if not name.startswith("imu_network.")}
        return self.tensors

    def on_cells(self, geometry: MapGeometry) -> Weights:
        """Return the weights for maps of other cells; for networks with ``fits_any_cells``."""
        network = replace(self.recipe.network, geometry=geometry)
        return replace(self, recipe=replace(self.recipe, network=network))

    def asked(self, iterations: int) -> Weights:
        """Return the weights for a network that is asked for the residual this number of times; 0: as in training."""
        if not iterations:
            return self
        return replace(self, recipe=replace(self.recipe, network=replace(self.recipe.network, iterations=iterations)))

    def network(self, device: torch.device | str = "cpu") -> OdometryNetwork:
        """Return the trained network in evaluation mode."""
        with torch.device("meta"):  # a damaged recipe may announce a network of any size
            _check_fit(own_tensors(OdometryNetwork(self.recipe.network)), self.tensors, self.where)
        network = OdometryNetwork(self.recipe.network)
        put_weights(network, self.tensors, self.where)
        return network.to(device).eval()


def own_tensors(network: nn.Module) -> dict[str, Tensor]:
    """Return a network's weights and buffers by name; a tensor that two parts share appears once."""
    found: dict[str, Tensor] = {}
    seen: set[int] = set()
    for name, tensor in network.state_dict(keep_vars=True).items():
        if id(tensor) not in seen:
            seen.add(id(tensor))
            found[name] = tensor.detach()
    return found


def put_weights(network: nn.Module, tensors: Mapping[str, Tensor], where: str) -> None:
    """Copy weights into a network.

    Raises:
        ConfigError: they do not fit; lists tensors that are missing, unknown or of another shape.
    """
    own = own_tensors(network)
    _check_fit(own, tensors, where)
    with torch.no_grad():
        for name, tensor in own.items():
            tensor.copy_(tensors[name])


def _check_fit(own: Mapping[str, Tensor], tensors: Mapping[str, Tensor], where: str) -> None:
    wrong = [f"{name} is missing" for name in own if name not in tensors]
    wrong += [f"{name} is unknown" for name in tensors if name not in own]
    wrong += [
        f"{name} is {tuple(tensors[name].shape)}, the network's is {tuple(tensor.shape)}"
        for name, tensor in own.items()
        if name in tensors and tensors[name].shape != tensor.shape
    ]
    if wrong:
        more = f" and {len(wrong) - _LISTED} more" if len(wrong) > _LISTED else ""
        raise ConfigError(
            f"{where}: do not fit the network ({'; '.join(wrong[:_LISTED])}{more}); use the recipe in their file"
        )


def save_weights(
    path: str | os.PathLike[str], network: OdometryNetwork, recipe: Recipe, about: Mapping[str, str]
) -> None:
    """Write a network's weights with their recipe and ``about`` as metadata; the file appears complete."""
    metadata = {
        "recipe": json.dumps(to_dict(recipe)),
        "hybridlio": __version__,
        "commit": _commit(),
        **about,
    }
    tensors = {name: tensor.cpu().contiguous() for name, tensor in own_tensors(network).items()}
    write_atomically(path, save(tensors, metadata))


def weights_path(name: str | os.PathLike[str]) -> Path:
    """Return the file of a name as settings have it.

    Args:
        name: a path; ``shipped``; or the name of weights that come with the package, such as ``published``. A file of
            that name in the working directory goes first.

    Raises:
        ConfigError: no weights of that name are shipped; lists those that are.
    """
    if str(name) == SHIPPED:
        return shipped()
    path = Path(name).expanduser()
    is_name = len(path.parts) == 1 and not path.suffix and not path.exists()
    return shipped(str(name)) if is_name else path


def load_weights(path: str | os.PathLike[str]) -> Weights:
    """Read weights.

    Raises:
        DataError: the file is missing, damaged, or carries no recipe.
    """
    path = Path(path)
    try:
        with safe_open(str(path), "pt") as file:
            metadata = dict(file.metadata() or {})
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  (not a mapping)
        if broken := [name for name, tensor in tensors.items() if not tensor.isfinite().all()]:
            raise DataError(f"{path}: {broken[0]} holds numbers that are not finite; train the weights again")
    except (OSError, SafetensorError) as error:
        raise DataError(f"{path}: weights cannot be read ({error})") from error
    try:
        recipe = from_dict(Recipe, json.loads(metadata.pop("recipe")), "recipe")
    except (KeyError, ValueError, ConfigError) as error:
        raise DataError(
            f"{path}: the metadata hold no recipe that this version reads ({error}); train the weights again"
        ) from error
    return Weights(recipe, metadata, tensors, str(path))


def _commit() -> str:
    """Return the commit of the checkout, empty for an installed package."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return ""
    try:
        found = subprocess.run(
            ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=40"],
            capture_output=True,
            text=True,
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        return ""
    return found.stdout.strip()
