"""Train and evaluate the rows of a comparison with equal budgets; finished rows are reused."""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from hybridlio.cloud.map_geometry import MapGeometry
from hybridlio.core.errors import ConfigError
from hybridlio.core.files import write_atomically
from hybridlio.learned.data.pairs import Pairs
from hybridlio.learned.data.shards import Shard
from hybridlio.learned.setting_values import from_dict, to_dict
from hybridlio.learned.settings import Recipe
from hybridlio.learned.training import checkpoints
from hybridlio.learned.training.ablation_results import RowResult
from hybridlio.learned.training.driving import drive
from hybridlio.learned.training.run_options import RunOptions, TrainingProgress, Watchers
from hybridlio.learned.training.train import train

RESULT = "result.json"
_DRIVEN = 8  # of the training recordings: driving through all of a hundred would take longer than the training


@dataclass(frozen=True)
class RowData:
    """Shards of a row, prepared for its recipe (map geometry, IMU rows, ground).

    Attributes:
        train, test: training and test recordings; drift is measured on eight of the former, spread over them, and on
            the latter.
    """

    train: Sequence[Shard]
    test: Sequence[Shard]


def run_rows(
    recipes: Sequence[Recipe],
    data: Callable[[Recipe], RowData],
    out: str | os.PathLike[str],
    steps: int,
    options: RunOptions | None = None,
    progress: Callable[[Recipe, TrainingProgress], None] | None = None,
) -> list[RowResult]:
    """Train each recipe for the same number of steps and measure the drift of its chained steps.

    The folder of a row, ``out/NAME``, holds its training run and ``result.json``. With the same recipe and budget a
    finished row is read from there, and an interrupted one resumes from its checkpoint.

    Args:
        recipes: the rows, with different names.
        data: returns the shards of a row.
        out: folder of the comparison.
        steps: training steps of each row.
        options: device and checkpoints; ``max_steps`` is set to ``steps``.
        progress: called after every training step.

    Raises:
        ConfigError: two rows have the same name, or a row's folder holds a run with other settings.
    """
    if len({recipe.name for recipe in recipes}) != len(recipes):
        raise ConfigError("two rows of a comparison have the same name; rename one recipe")
    return [_row(recipe, data, Path(out) / recipe.name, steps, options, progress) for recipe in recipes]


def _row(
    recipe: Recipe,
    data: Callable[[Recipe], RowData],
    folder: Path,
    steps: int,
    options: RunOptions | None,
    progress: Callable[[Recipe, TrainingProgress], None] | None,
) -> RowResult:
    found = _finished(folder / RESULT, recipe, steps)
    if found is not None:
        return found
    shards = data(recipe)
    pairs = Pairs(shards.train, recipe.network)
    an_epoch = math.ceil(len(pairs) / recipe.optimiser.batch)
    recipe = replace(recipe, optimiser=replace(recipe.optimiser, epochs=math.ceil(steps / an_epoch)))
    options = replace(options or RunOptions(), max_steps=steps)
    began = time.monotonic()
    tick = None if progress is None else lambda done: progress(recipe, done)
    network = train(recipe, pairs, folder, options=options, watchers=Watchers(tick))
    seconds = time.monotonic() - began
    driven = spread_over(shards.train, _DRIVEN), shards.test
    drifts = [{s.info.name: drive(network, s).drift for s in part} for part in driven]
    seen = sum(min(recipe.optimiser.batch, len(pairs) - k % an_epoch * recipe.optimiser.batch) for k in range(steps))
    result = RowResult(recipe.name, steps, seen, round(seconds, 1), *drifts)
    write_atomically(folder / RESULT, json.dumps({**asdict(result), "recipe": to_dict(recipe)}, indent=2) + "\n")
    return result


def spread_over(shards: Sequence[Shard], count: int) -> list[Shard]:
    """Return at most ``count`` shards, evenly spread over the given ones."""
    if len(shards) <= count:
        return list(shards)
    return [shards[k * len(shards) // count] for k in range(count)]


def _finished(path: Path, recipe: Recipe, steps: int) -> RowResult | None:
    if not path.is_file():
        return None
    values = json.loads(path.read_text())
    trained = from_dict(Recipe, values.pop("recipe"), str(path))
    wanted = replace(recipe, optimiser=replace(recipe.optimiser, epochs=trained.optimiser.epochs))
    differing = checkpoints.differences(wanted, trained)
    if values["steps"] != steps:
        differing.append(f"steps: {values['steps']} → {steps}")
    if differing:
        raise ConfigError(
            f"{path}: result of another comparison ({'; '.join(differing)}); choose another folder or delete it"
        )
    for part in ("train", "test"):
        values[part] = {name: None if d is None else (d[0], d[1]) for name, d in values[part].items()}
    return RowResult(**values)


def reduced(recipe: Recipe, geometry: MapGeometry | None = None, batch: int = 8, rate: float = 1e-3) -> Recipe:
    """Return a recipe that trains on a CPU in minutes: coarser maps, a quarter of the channels, one block per stage.

    Settings that distinguish rows of a comparison are kept. Results are worse than at full size.

    Args:
        recipe: full-size recipe.
        geometry: cells of the maps; None takes half of the rows and a quarter of the columns.
        batch: pairs per step.
        rate: constant learning rate.
    """
    network, cells = recipe.network, recipe.network.geometry
    if geometry is None:
        geometry = replace(cells, rows=math.ceil(cells.rows / 2), columns=math.ceil(cells.columns / 4))
    small = replace(
        network,
        geometry=geometry,
        imu_hidden=min(network.imu_hidden, 32),
        imu_layers=1,
        stem=min(network.stem, 8),
        stages=tuple(max(channels // 4, 8) for channels in network.stages),
        blocks=1,
        features=min(network.features, 64),
    )
    optimiser = replace(recipe.optimiser, batch=batch, learning_rate=rate, schedule="step", step_epochs=10**6)
    return replace(recipe, network=small, optimiser=optimiser)
