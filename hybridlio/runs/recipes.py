"""Which recipe a training run follows: a preset or the one behind given weights, with what a file changes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hybridlio.cloud.projection import map_geometry
from hybridlio.core.errors import ConfigError
from hybridlio.core.files import read_yaml
from hybridlio.learned.presets import preset
from hybridlio.learned.settings import Recipe, from_dict, to_dict

if TYPE_CHECKING:
    from hybridlio.learned.networks.weights import Weights

LSTM = "lstm"
_ADAPTING = {"epochs": 10, "schedule": "cosine"}
_GENTLER = 0.1  # adaptation starts with this share of the learning rate that found the weights


def adaptation(recipe: Recipe) -> Recipe:
    """The recipe to go on with weights on another's recordings: the same network and loss, gentle steps, few epochs."""
    if recipe.name.endswith("-adapted"):
        return recipe
    rate = recipe.optimiser.learning_rate * _GENTLER
    optimiser = replace(recipe.optimiser, learning_rate=rate, **_ADAPTING)  # type: ignore[arg-type]
    return replace(recipe, name=f"{recipe.name}-adapted", optimiser=optimiser)


def changed_by_file(recipe: Recipe, path: Path) -> Recipe:
    """The recipe with what a YAML or JSON file says; what it leaves out stays.

    The file has the sections of a run's ``recipe.json``; ``network.geometry`` may also be the name of a lidar.

    Raises:
        ConfigError: no such file, not YAML, an unknown key or a value out of range; names each.
    """
    tree = read_yaml(path, ConfigError) or {}
    if not isinstance(tree, dict):
        raise ConfigError(f"{path}: expected sections (network, loss, optimiser), got {type(tree).__name__}")
    network = tree.get("network")
    if isinstance(network, dict) and isinstance(network.get("geometry"), str):
        tree = {**tree, "network": {**network, "geometry": asdict(map_geometry(network["geometry"]))}}
    return from_dict(Recipe, _merged(to_dict(recipe), tree), str(path))


def with_initial_pose(recipe: Recipe, name: str | None) -> Recipe:
    """The recipe with initial poses by the network's own LSTMs (``lstm``), or given by a source of another name."""
    if name is None:
        return recipe
    network = replace(recipe.network, imu="initial-pose" if name == LSTM else "given")
    return replace(recipe, network=network)


def recipe_for(
    preset_name: str | None = None,
    behind: Recipe | None = None,
    file: Path | None = None,
    initial_pose: str | None = None,
    epochs: int | None = None,
) -> Recipe:
    """The recipe of a run.

    Args:
        preset_name: a preset; without it that of the given weights, gentler, or else ``default``.
        behind: the recipe of weights to start from.
        file: see :func:`changed_by_file`.
        initial_pose: see :func:`with_initial_pose`.
        epochs: in place of the recipe's.

    Raises:
        ConfigError: an unknown preset, or the file is no good.
    """
    recipe = adaptation(behind) if behind is not None and preset_name is None else preset(preset_name or "default")
    if file is not None:
        recipe = changed_by_file(recipe, file)
    recipe = with_initial_pose(recipe, initial_pose)
    if epochs is not None:
        recipe = replace(recipe, optimiser=replace(recipe.optimiser, epochs=epochs))
    return recipe


def lasting(recipe: Recipe, steps: int, pairs: int) -> Recipe:
    """The recipe with as many epochs as so many steps over so many pairs begin."""
    epochs = math.ceil(steps / math.ceil(pairs / recipe.optimiser.batch))
    return replace(recipe, optimiser=replace(recipe.optimiser, epochs=epochs))


def origin(name: str, weights: Weights) -> str:
    """Where a run started, for its weights' metadata: the file, and what that says of itself."""
    told = [f"{key} {weights.about[key]}" for key in ("data", "commit") if weights.about.get(key)]
    return f"{name} ({'; '.join([weights.recipe.name, *told])})"


def _merged(base: dict[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    out = dict(base)
    for key, value in changes.items():
        inner = out.get(key)
        whole = key == "geometry"  # its four numbers go together
        both = isinstance(inner, dict) and isinstance(value, Mapping) and not whole
        out[key] = _merged(inner, value) if both else value  # type: ignore[arg-type]
    return out
