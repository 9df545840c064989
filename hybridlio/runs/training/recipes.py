"""The recipe of a training run: a preset, or that of given weights, with changes from a file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hybridlio.cloud.map_geometry import map_geometry
from hybridlio.core.errors import ConfigError
from hybridlio.core.files import read_yaml
from hybridlio.learned.presets import preset
from hybridlio.learned.setting_values import from_dict, to_dict
from hybridlio.learned.settings import Recipe

if TYPE_CHECKING:
    from hybridlio.learned.networks.weights import Weights

LSTM = "lstm"
ADAPTED_SUFFIX = "-adapted"
# Adaptation of trained weights; measured with these values in docs/results.md (benchmarks/front_end.py --adapt).
_ADAPTATION_EPOCHS = 10
_ADAPTATION_RATE = 0.1  # share of the recipe's learning rate: small steps, which keep what the weights have learned


def adaptation_recipe(recipe: Recipe) -> Recipe:
    """Return the recipe to adapt weights to other recordings: same network and loss, few epochs with small steps."""
    if recipe.name.endswith(ADAPTED_SUFFIX):
        return recipe
    optimiser = replace(
        recipe.optimiser,
        learning_rate=recipe.optimiser.learning_rate * _ADAPTATION_RATE,
        epochs=_ADAPTATION_EPOCHS,
        schedule="cosine",
    )
    return replace(recipe, name=f"{recipe.name}{ADAPTED_SUFFIX}", optimiser=optimiser)


def with_file(recipe: Recipe, path: Path) -> Recipe:
    """Return the recipe with the values of a YAML or JSON file; values that the file omits stay.

    The file has the sections of a run's ``recipe.json``; ``network.geometry`` may also be the name of a lidar.

    Raises:
        ConfigError: the file is missing or not YAML, has an unknown key or a value out of range; names each.
    """
    tree = read_yaml(path, ConfigError) or {}
    if not isinstance(tree, dict):
        raise ConfigError(f"{path}: expected sections (network, loss, optimiser), got {type(tree).__name__}")
    network = tree.get("network")
    if isinstance(network, dict) and isinstance(network.get("geometry"), str):
        tree = {**tree, "network": {**network, "geometry": asdict(map_geometry(network["geometry"]))}}
    return from_dict(Recipe, _merge(to_dict(recipe), tree), str(path))


def with_initial_pose(recipe: Recipe, name: str | None) -> Recipe:
    """Return the recipe with initial poses from the network's own LSTMs (``lstm``), or given by another source."""
    if name is None:
        return recipe
    network = replace(recipe.network, imu="initial-pose" if name == LSTM else "given")
    return replace(recipe, network=network)


def choose_recipe(
    preset_name: str | None = None,
    weights_recipe: Recipe | None = None,
    file: Path | None = None,
    initial_pose: str | None = None,
    epochs: int | None = None,
) -> Recipe:
    """Return the recipe of a training run.

    Args:
        preset_name: a preset; None for that of the given weights, adapted, or without weights for ``default``.
        weights_recipe: the recipe of the weights to start from.
        file: see :func:`with_file`.
        initial_pose: see :func:`with_initial_pose`.
        epochs: replaces the recipe's number of epochs.

    Raises:
        ConfigError: the preset is unknown, or the file is invalid.
    """
    if weights_recipe is not None and preset_name is None:
        recipe = adaptation_recipe(weights_recipe)
    else:
        recipe = preset(preset_name or "default")
    if file is not None:
        recipe = with_file(recipe, file)
    recipe = with_initial_pose(recipe, initial_pose)
    if epochs is not None:
        recipe = replace(recipe, optimiser=replace(recipe.optimiser, epochs=epochs))
    return recipe


def for_steps(recipe: Recipe, steps: int, pairs: int) -> Recipe:
    """Return the recipe with the number of epochs that this number of steps begins, given the number of pairs."""
    epochs = math.ceil(steps / math.ceil(pairs / recipe.optimiser.batch))
    return replace(recipe, optimiser=replace(recipe.optimiser, epochs=epochs))


def describe_origin(name: str, weights: Weights) -> str:
    """Return the origin of a run for its weights' metadata: the initial weights' file, recipe, data and commit."""
    details = [f"{key} {weights.about[key]}" for key in ("data", "commit") if weights.about.get(key)]
    return f"{name} ({'; '.join([weights.recipe.name, *details])})"


def _merge(base: dict[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    out = dict(base)
    for key, value in changes.items():
        inner = out.get(key)
        is_nested = isinstance(inner, dict) and isinstance(value, Mapping)
        replaces_whole = key == "geometry"  # its four numbers belong together
        out[key] = _merge(inner, value) if is_nested and not replaces_whole else value  # type: ignore[arg-type]
    return out
